"""Diagnosis cards of typical flights, for the tests of what prints them."""

from px4fuse.card.model import (
    Action,
    AnalysisDescription,
    CardRerun,
    DiagnosedCause,
    DiagnosisCard,
    FlightErrors,
    Note,
    Verdict,
)


def _verdict(owner, against, ratio, word, **fields):
    return Verdict(filter=owner, against=against, ratio=ratio, word=word, samples=600, **fields)


def verdicts(*ratios_and_words):
    """Return the four verdicts from four pairs of ratio and word."""
    rows = [(owner, against) for owner in ("kf", "ekf2") for against in ("source", "truth")]
    return tuple(_verdict(*row, *pair) for row, pair in zip(rows, ratios_and_words, strict=True))


SMALL_SIGMA_A = DiagnosisCard(
    severity="error",
    id="process_noise_near_zero",
    headline="SIGMA_A is 360 times too small: KF ignores new positions",
    effect=FlightErrors(
        axis="along the aisle, 30° from north",
        position_rmse_m={"kf": 2.11, "ekf2": 0.063},
        horizontal_rmse_m={"kf": 7.0, "ekf2": 0.09},
        difference_rms_m=2.11,
        rejected_fraction=0.0,
        horizontal_resets=0,
    ),
    effect_text="KF: position RMSE 2.11 m against ground truth along the aisle (7.00 m "
    "horizontal), 128 times its reported σ. EKF2, with the same positions: 0.063 m, consistent.",
    do_this=("Run KF again with --sigma-a 0.363, or without --sigma-a (default 0.5).",),
    verdicts=verdicts(
        (21.0, "overconfident"),
        (128.0, "overconfident"),
        (0.93, "consistent"),
        (1.06, "consistent"),
    ),
    difference="Position difference KF − EKF2: 2.11 m RMS; 0.069 m after the fix.",
    causes=(
        DiagnosedCause(
            id="process_noise_near_zero",
            severity="error",
            title="SIGMA_A is 360 times too small: KF ignores new positions",
            why="SIGMA_A 0.001 m/s²; maximum-likelihood estimate 0.363 m/s², 95 % interval 0.322 "
            "to 0.412 m/s². The process noise is almost zero. σ stops growing between updates, the "
            "gain falls to 0.02, and KF needs 9 s to follow a change.",
            actions=(
                Action(
                    "KF", commands=("px4fuse compare aisle_uwb.ulg --sigma-a 0.363",), where="shell"
                ),
                Action("EKF2", "keep the settings: the reported σ is consistent"),
            ),
            reruns=(
                CardRerun(
                    label="KF, --sigma-a 0.363",
                    position_rmse_m=(2.11, 0.060),
                    source_ratio=(21.0, 0.94),
                    truth_ratio=(128.0, 0.90),
                    improves="position and σ",
                ),
                CardRerun(
                    label="KF, default 0.5",
                    position_rmse_m=(2.11, 0.062),
                    source_ratio=(21.0, 0.92),
                    truth_ratio=(128.0, 0.87),
                    improves="position and σ",
                ),
            ),
            after="Without --sigma-a (default 0.5) KF is as good: both values are consistent.",
        ),
    ),
    notes=(
        Note(
            "source_rate_at_limit",
            "UWB positions come at 5.0 Hz. EKF2 lost fusion for 0.9 s.",
            "Send 10 Hz.",
        ),
    ),
    identity=AnalysisDescription(
        file="aisle_uwb.ulg",
        firmware="PX4 v1.16.1",
        duration_s=129.7,
        source="UWB 5.0 Hz",
        changed=("--sigma-a 0.001 (default 0.5)",),
    ),
)
