# ruff: noqa: E501 - one fault per line
"""First findings of flights with one fault of the position source, from small to large.

``single_faults.py [--flights 300]`` simulates flights over a square and along an aisle, changes the
messages of ``vehicle_visual_odometry`` (or of GNSS) by one fault, reads the ULog and analyses it.
It prints the share of flights whose first finding (warning or error) is

- correct: the finding of the fault
- acceptable: another true statement about it
- wrong: any other finding
- missed: none

per kind and size, and the wrong first findings by kind. Flights without a fault count as correct
without a finding.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from px4fuse.diagnose import diagnose
from px4fuse.errors import Px4FuseError
from px4fuse.request import ComparisonRequest
from px4fuse.simulation.faults import FaultSizes
from px4fuse.simulation.flights import simulate, to_flight
from px4fuse.simulation.scenario import Scenario, make_scenario

TOPIC = "vehicle_visual_odometry"
Values = NDArray[np.float64]


class Sent(NamedTuple):
    """Messages of a source: arrival and measurement times (s), and fields of the topic."""

    time_s: Values
    fields: dict[str, Any]
    rng: np.random.Generator

    @property
    def position_m(self) -> Values:
        return np.asarray(self.fields["position"], float)

    @property
    def between_s(self) -> tuple[float, float]:
        return float(self.time_s[0]), float(self.time_s[-1])

    def moved(self, position_m: Values) -> Sent:
        fields = {**self.fields, "position": position_m.astype(np.float32)}
        return self._replace(fields=fields)

    def kept(self, is_kept: NDArray[np.bool_]) -> Sent:
        fields = {name: value[is_kept] for name, value in self.fields.items()}
        return self._replace(time_s=self.time_s[is_kept], fields=fields)

    def stamped(self, stamp_s: Values) -> Sent:
        stamp = np.rint(stamp_s * 1e6).clip(0).astype(np.uint64)
        return self._replace(fields={**self.fields, "timestamp_sample": stamp})

    def turned(self, order: tuple[int, int, int, int], heading_deg: float = 0.0) -> Sent:
        q = np.asarray(self.fields["q"], float)
        turn = Rotation.from_euler("z", heading_deg, degrees=True)
        q = (turn * Rotation.from_quat(q, scalar_first=True)).as_quat(scalar_first=True)
        return self._replace(fields={**self.fields, "q": q[:, order].astype(np.float32)})

    def span(self, length_s: float, at: float = 0.5) -> NDArray[np.bool_]:
        start, end = self.between_s
        begin = start + at * (end - start)
        return (self.time_s >= begin) & (self.time_s < begin + length_s)


Change = Callable[[Sent, float], Sent]


class Kind(NamedTuple):
    """Kind of fault: change of the messages, its sizes, and findings that name it."""

    change: Change
    sizes: tuple[float, ...]
    correct: tuple[str, ...]
    acceptable: tuple[str, ...] = ()
    has_orientation: bool = False


def axes(*signed: int) -> Change:
    def change(sent: Sent, _: float) -> Sent:
        columns = [np.sign(one) * sent.position_m[:, abs(one) - 1] for one in signed]
        return sent.moved(np.column_stack(columns))

    return change


def rotate(sent: Sent, angle_deg: float) -> Sent:
    turn = Rotation.from_euler("z", angle_deg, degrees=True)
    return sent.moved(turn.apply(sent.position_m))


def hold(sent: Sent, length_s: float) -> Sent:
    position, rows = sent.position_m, np.flatnonzero(sent.span(length_s))
    position[rows] = position[rows[0] - 1]
    return sent.moved(position)


def repeat(sent: Sent, share: float) -> Sent:
    position = sent.position_m
    for row in np.flatnonzero(sent.rng.random(len(position)) < share):
        position[row] = position[max(row - 1, 0)]
    return sent.moved(position)


def fill(value: float) -> Change:
    def change(sent: Sent, length_s: float) -> Sent:
        position = sent.position_m
        position[sent.span(length_s)] = value
        return sent.moved(position)

    return change


def jump(sent: Sent, size_m: float, *, is_announced: bool = False) -> Sent:
    after = sent.span(1e9, 0.6)
    angle = sent.rng.uniform(0.0, 2.0 * np.pi)
    moved = sent.moved(
        sent.position_m + after[:, None] * size_m * np.array([np.cos(angle), np.sin(angle), 0.0])
    )
    counter = after.astype(np.uint8) if is_announced else moved.fields["reset_counter"]
    return moved._replace(fields={**moved.fields, "reset_counter": counter})


def announced_jump(sent: Sent, size_m: float) -> Sent:
    return jump(sent, size_m, is_announced=True)


def low_pass(sent: Sent, tau_s: float) -> Sent:
    position = sent.position_m
    for row, step in enumerate(np.diff(sent.time_s)):
        keep = np.exp(-step / tau_s)
        position[row + 1] = keep * position[row] + (1.0 - keep) * position[row + 1]
    return sent.moved(position)


def correlated(tau_s: float) -> Change:
    def change(sent: Sent, size_m: float) -> Sent:
        error = np.zeros((len(sent.time_s), 3))
        error[0] = sent.rng.normal(size=3)
        for row, step in enumerate(np.diff(sent.time_s)):
            rho = np.exp(-step / tau_s)
            error[row + 1] = rho * error[row] + np.sqrt(1.0 - rho**2) * sent.rng.normal(size=3)
        return sent.moved(sent.position_m + size_m * error)

    return change


def outliers(sent: Sent, share: float) -> Sent:
    is_far = sent.rng.random(len(sent.time_s)) < share
    error = sent.rng.normal(size=(len(is_far), 3)) * [2.0, 2.0, 0.3]
    return sent.moved(sent.position_m + is_far[:, None] * error)


def noisier(sent: Sent, factor: float) -> Sent:
    sigma = np.sqrt(sent.fields["position_variance"][0, 0])
    rows = sent.span((sent.time_s[-1] - sent.time_s[0]) / 3.0, 0.33)
    noise = sent.rng.normal(size=(len(rows), 3)) * sigma * np.sqrt(factor**2 - 1.0)
    return sent.moved(sent.position_m + rows[:, None] * noise)


def two_senders(sent: Sent, size_m: float) -> Sent:
    every_other = (np.arange(len(sent.time_s)) % 2)[:, None]
    return sent.moved(sent.position_m + every_other * size_m * np.array([0.8, 0.6, 0.0]))


def lever_arm(sent: Sent, size_m: float) -> Sent:
    body_to_ned = Rotation.from_quat(sent.fields["q"], scalar_first=True)
    return sent.moved(sent.position_m + body_to_ned.apply([0.8 * size_m, 0.6 * size_m, 0.0]))


def report_variance(sent: Sent, factor: float) -> Sent:
    variance = (sent.fields["position_variance"] * factor).astype(np.float32)
    return sent._replace(fields={**sent.fields, "position_variance": variance})


def clock_drift(sent: Sent, drift: float) -> Sent:
    middle = np.mean(sent.between_s)
    return sent.stamped(sent.time_s + drift * (sent.time_s - middle))


def scale(sent: Sent, share: float) -> Sent:
    return sent.moved(sent.position_m * (1.0 + share))


# Against ground truth a small error is visible that the IMU does not show
HIDDEN = ("error_exceeds_reported_sigma",)
MISALIGNED = ("source_frame_misaligned",)
TIME = ("source_time_offset",)
KINDS: dict[str, Kind] = {
    "clean": Kind(lambda sent, _: sent, (0.0,) * 4, ()),
    "ENU": Kind(axes(2, 1, -3), (0.0,) * 3, ("source_axes_wrong",), ("source_convention_ambiguous",)),
    "NWU": Kind(axes(1, -2, -3), (0.0,) * 3, ("source_axes_wrong",), ("source_convention_ambiguous",)),
    "z up": Kind(axes(1, 2, -3), (0.0,) * 3, ("source_axes_wrong",), ("source_convention_ambiguous",)),
    "y mirrored": Kind(axes(1, -2, 3), (0.0,) * 3, ("source_axes_wrong",), ("source_convention_ambiguous",)),
    "unit": Kind(lambda sent, factor: sent.moved(factor * sent.position_m), (3.281, 100.0, 1000.0), ("source_unit_wrong",)),
    "yaw": Kind(rotate, (6.0, 12.0, 25.0, 60.0, 120.0, 180.0), MISALIGNED, ("source_axes_wrong", *HIDDEN)),
    "late": Kind(lambda sent, late: sent.stamped(sent.time_s + late), (0.05, 0.1, 0.2, -0.15, 0.6, 2.0, 5.0), TIME),
    "clock drift": Kind(clock_drift, (0.002, 0.005, 0.01, 0.03), ("source_time_offset_changes",)),
    "milliseconds": Kind(lambda sent, _: sent.stamped(1e-3 * sent.time_s), (0.0,) * 2, ("source_timestamp_unit",)),
    "UNIX": Kind(lambda sent, _: sent.stamped(1.7e9 + sent.time_s), (0.0,) * 2, ("source_timestamp_unit",)),
    "whole seconds": Kind(lambda sent, step: sent.stamped(step * np.floor(sent.time_s / step)), (0.5, 1.0), ("source_timestamps_shared",)),
    "stops": Kind(lambda sent, at: sent.kept(~sent.span(1e9, at)), (0.3, 0.6, 0.85), ("source_stops",)),
    "begins": Kind(lambda sent, at: sent.kept(sent.span(1e9, at)), (0.2, 0.5), ("source_begins",)),
    "gap": Kind(lambda sent, length: sent.kept(~sent.span(length)), (1.5, 5.0, 20.0), ("source_gap",)),
    "holds": Kind(hold, (2.0, 5.0, 15.0), ("source_position_held",)),
    "repeats": Kind(repeat, (0.3, 0.6), ("source_samples_repeated",)),
    "zeros": Kind(fill(0.0), (1.0, 5.0, 15.0), ("source_zero_positions",)),
    "NaN": Kind(fill(np.nan), (2.0, 5.0, 15.0), ("source_without_position", "source_gap")),
    "jump": Kind(jump, (0.4, 1.0, 5.0, 40.0), ("source_position_jump",)),
    "jump, counter": Kind(announced_jump, (0.5, 3.0), ("source_position_jump",)),
    "rounded": Kind(lambda sent, step: sent.moved(step * np.round(sent.position_m / step)), (0.1, 0.25, 1.0), ("source_positions_rounded",)),
    "low pass": Kind(low_pass, (0.3, 0.6, 1.5, 4.0), ("source_low_pass_filtered",)),
    "AR(1) 1 s": Kind(correlated(1.0), (0.08, 0.3, 1.0), ("source_noise_time_correlated",)),
    "AR(1) 8 s": Kind(correlated(8.0), (0.2, 0.6, 2.0), ("source_noise_time_correlated",), ("error_exceeds_reported_sigma", "source_drift")),
    "outliers": Kind(outliers, (0.01, 0.05, 0.2), ("source_outliers",)),
    "noise varies": Kind(noisier, (3.0, 10.0, 40.0), ("source_noise_varies",)),
    "scale": Kind(scale, (0.08, 0.2, 0.4), ("source_scale_error",), ("source_unit_wrong", *HIDDEN)),
    "variance": Kind(report_variance, (0.01, 0.1, 10.0, 100.0), ("source_reported_variance_wrong",)),
    "two senders": Kind(two_senders, (0.3, 1.0, 5.0), ("source_two_senders",)),
    "lever arm": Kind(lever_arm, (0.3, 0.6, 1.5), ("source_lever_arm",)),
    "quaternion order": Kind(lambda sent, _: sent.turned((1, 2, 3, 0)), (0.0,) * 2, ("source_orientation_wrong",), (), True),
    "heading of q": Kind(lambda sent, angle: sent.turned((0, 1, 2, 3), angle), (25.0, 90.0, 180.0), ("source_orientation_wrong",), (), True),
}  # fmt: skip


class Job(NamedTuple):
    """Flight with one fault."""

    kind: str
    size: float
    seed: int


def scenario_of(job: Job) -> Scenario:
    """Return the flight of a seed: a square with a turning or fixed nose, or an aisle."""
    sigma_m, rate_hz = ((0.05, 10.0), (0.1, 10.0), (0.02, 20.0))[job.seed % 3]
    heading_deg = 37.0 * job.seed % 360.0
    return make_scenario(
        "loop", vio_rate_hz=rate_hz, sigma_vio_m=sigma_m, vio_drift=0.0, vio_walk_m=0.0,
        ekf2=False, heading_deg=heading_deg, seed=job.seed,
    )  # fmt: skip


def fly(job: Job) -> tuple[Job, list[tuple[str, str]]]:
    """Return id and title of the findings above notes of one flight, causes first."""
    kind = KINDS[job.kind]
    scenario = scenario_of(job)
    simulation = simulate(scenario, FaultSizes())
    (topic,) = (one for one in simulation.topics if one.name == TOPIC)
    fields = {name: np.array(value) for name, value in topic.fields.items()}
    time_s = np.asarray(fields["timestamp_sample"], float) * 1e-6
    sent = Sent(time_s, fields, np.random.default_rng(job.seed + 991))
    sent = kind.change(sent, job.size)
    if not kind.has_orientation:
        sent.fields["q"] = np.full_like(sent.fields["q"], np.nan)
    changed = replace(topic, fields=sent.fields)
    topics = tuple(changed if one is topic else one for one in simulation.topics)
    parameters = {**simulation.parameters, "EKF2_EV_NOISE_MD": 0}
    flight = to_flight(replace(simulation, topics=topics, parameters=parameters))
    try:
        request = ComparisonRequest(log=flight.log.name, sigma_z_m=scenario.source_sigma_m)
        analysis = diagnose(request, flight=flight)
    except Px4FuseError as error:
        return job, [(error.id, str(error))]
    return job, [
        (one.id, one.title)
        for one in analysis.findings
        if one.severity != "note" and one.id not in ("ekf2_not_logged", "source_not_logged")
    ]


def judge(job: Job, found: list[tuple[str, str]]) -> str:
    """Return the result of one flight."""
    kind, first = KINDS[job.kind], found[0][0] if found else ""
    if not kind.correct:
        return "wrong" if first else "correct"
    if first in kind.correct:
        return "correct"
    if not first:
        return "missed"
    return "acceptable" if first in kind.acceptable else "wrong"


def jobs(count: int, only: str, first_seed: int) -> Iterator[Job]:
    """Yield flights of all kinds and sizes in turn."""
    pairs = [(name, size) for name, kind in KINDS.items() for size in kind.sizes if only in name]
    for number in range(max(count, len(pairs))):
        name, size = pairs[number % len(pairs)]
        yield Job(name, size, first_seed + number)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--first", type=int, default=5000, help="first seed")
    parser.add_argument("--only", default="")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    confusion: Counter[tuple[str, str]] = Counter()
    with ProcessPoolExecutor(options.jobs) as pool:
        for job, found in pool.map(fly, jobs(options.flights, options.only, options.first)):
            result = judge(job, found)
            counts[job.kind][result] += 1
            counts["all" if job.kind != "clean" else "all clean"][result] += 1
            if result in ("wrong", "missed"):
                confusion[job.kind, found[0][0] if found else "nothing"] += 1
                others = " | ".join(f"{name}: {title}" for name, title in found[:3])
                print(f"{result:8s} {job.kind} {job.size:g} seed {job.seed}: {others}", flush=True)
    for name, results in counts.items():
        total = sum(results.values())
        shares = ", ".join(f"{result} {number}" for result, number in results.most_common())
        print(f"{name:18s} {total:4d}: {shares} ({100.0 * results['correct'] / total:.0f} %)")
    for (kind, name), number in confusion.most_common():
        print(f"{number:3d}  {kind} → {name}")


if __name__ == "__main__":
    main()
