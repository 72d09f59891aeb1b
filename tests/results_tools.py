"""Results for tests: those of the example report, and of a small loop."""

import copy
import json
from pathlib import Path
from typing import Any

from px4fuse.core.record import Unavailable
from px4fuse.loop.model import Loop, LoopClosure, OdometryNoise, PathResult, TrueFinalPose
from px4fuse.request import LoopRequest
from px4fuse.results.contract import LoopResults, Results, to_json_dict
from px4fuse.results.model import SCHEMA_VERSION, Schema, Student, provenance
from px4fuse.results.reading import read_results
from px4fuse.trajectory.alignment import Transform
from px4fuse.trajectory.association import Association
from px4fuse.trajectory.evaluation import AbsoluteTrajectoryError, Evaluation
from px4fuse.trajectory.model import TrajectorySummary
from px4fuse.trajectory.scores import RelativePoseError, RmseInterval, Statistics
from px4fuse.trajectory.time_offset import TimeOffset

SHIPPED = Path(__file__).parent.parent / "reports" / "example" / "aisle_uwb.json"
EXAMPLE: dict[str, Any] = json.loads(SHIPPED.read_text(encoding="utf-8"))
SHA256 = EXAMPLE["log"]["sha256"]
NONE = Unavailable("it", "nobody asked", "Ask.")


def correction(rmse: float, moved_m: float) -> PathResult:
    """Return a correction with one score."""
    statistics = Statistics(9, rmse, rmse, rmse, 0.0, rmse, rmse)
    score = Evaluation(
        alignment="se3",
        alignment_reason="asked",
        transform=Transform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, 6),
        association=Association("interpolate", 9, 0.1, 0, 0, 1.0, 1.0),
        time_offset=TimeOffset(offset_s=0.0, is_determinable=True, reason=""),
        ate=AbsoluteTrajectoryError(statistics, RmseInterval(rmse, rmse, 1, 9.0), NONE),
        rpe=(RelativePoseError(5.0, "m", True, "reference", statistics, NONE, NONE),),
        notes=(),
        warnings=(),
    )
    return PathResult(
        correction_max_m=moved_m, correction_rms_m=moved_m, scores={"slam.tum": score, "ekf2": NONE}
    )


LOOP = to_json_dict(
    LoopResults(
        schema=Schema("px4fuse-loop", SCHEMA_VERSION),
        request=LoopRequest(source="loop.ulg:vio"),
        track=TrajectorySummary("loop.ulg:vio", SHA256, 9, "vio", "NED", 9, 1.0, 95.0, True, ()),
        references=(),
        loop=Loop(
            track="loop.ulg:vio",
            kind="vio",
            frame="NED",
            start_s=1.0,
            end_s=95.0,
            part_reason="the flight",
            poses=9,
            key_frames=9,
            key_frame_spacing_m=0.5,
            path_length_m=87.7,
            end_from_start_m={"north": 1.42, "east": 0.0, "down": 0.0},
            true_end=TrueFinalPose(
                displacement_m={"north": 0.0, "east": 0.0, "down": 0.0},
                sigma_m=0.1,
                source="landing",
                assumed=True,
            ),
            closure_error_m=1.42,
            closure_percent=1.62,
            heading_error_deg=NONE,
            is_absolute_track=False,
            odometry_noise=OdometryNoise(),
            closures=(
                LoopClosure(
                    time_1_s=1.0,
                    time_2_s=95.0,
                    sigma_m=0.1,
                    source="landing",
                    distance_m=1.4,
                    d2=2.0,
                    degrees_of_freedom=3,
                    p=0.5,
                    accepted=True,
                ),
            ),
            corrections={
                "uncorrected": correction(0.41, 0.0),
                "by_distance_plain": NONE,
                "by_distance": correction(0.26, 1.4),
                **{f"pose_graph_{name}": NONE for name in ("gated", "gnc")},
            },
            notes=(),
        ),
        findings=(),
        student=Student(),
        provenance=provenance("px4fuse loop loop.ulg:vio"),
    )
)


def changed_results(results: dict[str, Any] = EXAMPLE, **values: Any) -> dict[str, Any]:
    """Return results with changed values by path ("__" instead of dots); ``...`` removes one."""
    changed_ = copy.deepcopy(results)
    for path, value in values.items():
        *parents, last = path.split("__")
        place = changed_
        for parent in parents:
            place = place.setdefault(parent, {})
        if value is ...:
            place.pop(last, None)
        else:
            place[last] = value
    return changed_


def decode_results(results: dict[str, Any]) -> Results:
    """Decode results as from a report."""
    return read_results(json.dumps(results).encode())


def finding(name: str, severity: str = "warning") -> dict[str, Any]:
    """Return a finding as in results."""
    return {"id": name, "severity": severity, "message": "", "evidence": {}, "remedy": ""}
