"""EKF2's output predictor against a buffer, step by step."""

import numpy as np
import pytest
from findings_tools import made as made_of
from scipy.spatial.transform import Rotation

from px4fuse.ekf2.output_predictor import compute_published_state, sum_attitude_corrections
from px4fuse.ekf2.replay_segments import (
    ACCELEROMETER_BIAS,
    GRAVITY_M_S2,
    POSITION,
    VELOCITY,
    ReplaySegment,
)

STEP_S = 0.01


def buffered(gain, velocity, position, reset, lag, tau_v, tau_p):
    """Run the predictor as PX4: every entry of the buffer is corrected in each step."""
    n, k = gain.shape
    buffer = [(velocity[0].copy(), position[0].copy())]
    v, p = buffer[0]
    out_v, out_p = [v], [p]
    v_sum, p_sum = np.zeros(k), np.zeros(k)
    gv, gp = STEP_S / tau_v, STEP_S / tau_p
    for at in range(1, n + 1):
        v0 = v
        v = v + gain[at - 1]
        p = p + 0.5 * (v0 + v) * STEP_S
        buffer.append((v, p))
        if at >= lag:
            delayed = at - lag
            moved = reset[delayed] - reset[delayed - 1] if delayed else np.zeros(k)
            buffer = [(bv, bp + moved) for bv, bp in buffer]
            old_v, old_p = buffer[-1 - lag]
            v_error, p_error = velocity[delayed] - old_v, position[delayed] - old_p
            v_sum, p_sum = v_sum + v_error, p_sum + p_error
            dv = v_error * gv + v_sum * gv**2 * 0.1
            dp = p_error * gp + p_sum * gp**2 * 0.1
            buffer = [(bv + dv, bp + dp) for bv, bp in buffer]
        buffer = buffer[-(lag + 2) :]
        v, p = buffer[-1]
        out_v.append(v)
        out_p.append(p)
    return np.array(out_v), np.array(out_p)


@pytest.mark.parametrize("lag", [1, 6, 19])
def test_ekf2_output_predictor_equals_step_by_step_simulation(lag: int) -> None:
    rng = np.random.default_rng(lag)
    n = 400
    turn, turned = Rotation.random(n + 1, rng).as_matrix(), rng.normal(0.0, 0.1, (n + 1, 3))
    force, bias = rng.normal(0.0, 2.0, (n, 3)), np.full(3, 0.05)
    force_ned = np.einsum("nij,nj->ni", turn[1:], force - bias)
    gain = (force_ned + np.cross(turned[1:], force_ned) + GRAVITY_M_S2) * STEP_S
    velocity = np.cumsum(rng.normal(0.0, 0.03, (n + 1, 3)), axis=0) + 0.3
    position = np.cumsum(velocity * STEP_S, axis=0) + 4.0
    reset = np.zeros((n + 1, 3))
    reset[150:] = 0.7, -0.2, 0.0
    position += reset
    segment = made_of(
        ReplaySegment, body_to_ned=turn, specific_force_m_s2=force, step_s=np.full(n, STEP_S)
    )
    state = np.zeros((n + 1, 15))
    state[:, VELOCITY], state[:, POSITION], state[:, ACCELEROMETER_BIAS] = velocity, position, bias
    settings = {"EKF2_TAU_VEL": 0.25, "EKF2_TAU_POS": 0.4}
    made = compute_published_state(segment, state, reset, turned, lag, settings)
    expected = buffered(gain, velocity, position, reset, lag, 0.25, 0.4)
    for found, known in zip(made, expected, strict=True):
        assert found == pytest.approx(known, abs=1e-9)


def test_sum_of_attitude_corrections_equals_stepwise_sum() -> None:
    lag, horizon_s = 19, 0.2
    error = np.zeros((600, 3))
    error[100:] = 0.01, 0.0, -0.02
    made = sum_attitude_corrections(error, lag, STEP_S, horizon_s)
    share, expected = 0.5 * STEP_S / horizon_s, np.zeros((600, 3))
    for k in range(599):
        late = k - lag
        behind = error[late] - expected[late] if late >= 0 else np.zeros(3)
        expected[k + 1] = expected[k] + share * behind
    assert made == pytest.approx(expected, abs=1e-12)
    assert made[-1] == pytest.approx(error[-1], rel=0.01)
