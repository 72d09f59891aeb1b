"""Examples 1 and 2 of the lesson, digit for digit."""

from __future__ import annotations

import numpy as np

from px4fuse.lesson import example_1, kalman_lines, loop_lines

# as the lesson prints them
EXAMPLE_1 = """\
t 0.5 s: p 0.57 (true 0.50), v 0.57, sigma_p 0.099 m, sigma_v 0.719 m/s
t 1.0 s: p 0.88 (true 1.00), v 0.61, sigma_p 0.097 m, sigma_v 0.262 m/s
t 1.5 s: p 1.48 (true 1.50), v 0.98, sigma_p 0.090 m, sigma_v 0.164 m/s
t 2.0 s: p 2.06 (true 2.00), v 1.07, sigma_p 0.085 m, sigma_v 0.141 m/s
t 2.5 s: p 2.49 (true 2.50), v 0.97, sigma_p 0.082 m, sigma_v 0.137 m/s
t 3.0 s: p 2.93 (true 3.00), v 0.92, sigma_p 0.081 m, sigma_v 0.136 m/s
"""


def test_example_1_prints_the_lessons_six_lines() -> None:
    assert list(kalman_lines()) == EXAMPLE_1.splitlines()


def test_example_1_equals_the_lessons_own_loop_at_every_step() -> None:
    DT, SIGMA_A, SIGMA_Z = 0.1, 0.5, 0.10
    uwb_noise = [0.08, -0.12, 0.05, 0.10, -0.06, -0.09]
    x = [0.0, 0.0]
    P = [[0.5**2, 0.0], [0.0, 1.0**2]]
    q = SIGMA_A**2
    Q = [[q * DT**4 / 4, q * DT**3 / 2], [q * DT**3 / 2, q * DT**2]]
    expected = [[*x, P[0][0], P[0][1], P[1][1]]]
    for step in range(1, 31):
        x = [x[0] + DT * x[1], x[1]]
        P = [
            [
                P[0][0] + DT * (P[1][0] + P[0][1]) + DT * DT * P[1][1] + Q[0][0],
                P[0][1] + DT * P[1][1] + Q[0][1],
            ],
            [P[1][0] + DT * P[1][1] + Q[1][0], P[1][1] + Q[1][1]],
        ]
        if step % 5 == 0:
            z = 1.0 * step * DT + uwb_noise[step // 5 - 1]
            s = P[0][0] + SIGMA_Z**2
            k = [P[0][0] / s, P[1][0] / s]
            innov = z - x[0]
            x = [x[0] + k[0] * innov, x[1] + k[1] * innov]
            P = [
                [(1 - k[0]) * P[0][0], (1 - k[0]) * P[0][1]],
                [P[1][0] - k[1] * P[0][0], P[1][1] - k[1] * P[0][1]],
            ]
        expected.append([*x, P[0][0], P[0][1], P[1][1]])
    steps = example_1().steps.drop(columns=["acceleration_m_s2", "input_variance_m2_s4"])
    np.testing.assert_allclose(steps, expected, rtol=1e-12, atol=1e-12)


# as the lesson prints them
EXAMPLE_2 = """\
loop closure error (1.2, 0.8) m over 80.4 m = 1.8%
(  0.0,   0.0) -> ( 0.00,  0.00)
( 20.3,   0.2) -> (20.00, -0.00)
( 20.6,  20.4) -> (20.00, 20.00)
(  0.8,  20.9) -> (-0.10, 20.30)
(  1.2,   0.8) -> ( 0.00,  0.00)
"""


def test_example_2_prints_the_lessons_six_lines() -> None:
    assert list(loop_lines()) == EXAMPLE_2.splitlines()
