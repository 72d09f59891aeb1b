"""Words of findings for each kind of position source, and the kind of a source."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from flights import Uwb, aisle_flight

from px4fuse.findings.model import SOURCE_TEXTS, find_source_texts
from px4fuse.flight.model import Columns, PositionKind, PositionTrack, infer_position_kind

# Words that belong to some kinds of source only
WORDS_OF_KINDS: dict[str, set[PositionKind]] = {
    r"anchor|NLOS|line of sight|\btag\b": {"uwb"},
    r"antenna|receiver|satellite|RTK|GNSS|\bsky\b": {"gnss"},
    r"multipath|reflection": {"uwb", "gnss"},
    r"marker|camera|motion capture|rigid body": {"vio", "mocap"},
    r"\blight|texture|\bmap\b": {"vio"},
}
FINDINGS = Path(__file__).parents[1] / "px4fuse" / "findings"


@pytest.mark.parametrize(("words", "kinds"), WORDS_OF_KINDS.items())
def test_report_text_names_only_sensors_of_the_source_kind(words, kinds) -> None:
    for kind, texts in SOURCE_TEXTS.items():
        if kind not in (*kinds, "file"):
            for text in (getattr(texts, name) for name in texts.__struct_fields__):
                assert not re.search(words, text, re.IGNORECASE), (kind, text)


def test_report_text_exists_for_each_position_source_kind() -> None:
    for kind in PositionKind.__args__:
        source = SimpleNamespace(origin=SimpleNamespace(kind=kind))
        assert find_source_texts(SimpleNamespace(source=source)) is SOURCE_TEXTS[kind]  # type: ignore[arg-type]


def test_fault_detector_texts_contain_no_sensor_specific_words() -> None:
    pattern = re.compile(r"\"[^\"]*(anchor|NLOS|line of sight|marker|reflection|multipath)", re.I)
    for file in FINDINGS.glob("*.py"):
        for line in file.read_text().splitlines():
            assert not pattern.search(line), (file.name, line)


def track(rate_hz: float, sigma_m: float) -> PositionTrack:
    (made,) = aisle_flight(uwb=Uwb(rate_hz=rate_hz, sigma_m=sigma_m)).positions
    return made


@pytest.mark.parametrize(("rate_hz", "sigma_m", "kind"), [
    (5.0, 0.1, "uwb"), (20.0, 0.05, "uwb"), (100.0, 0.1, "unknown"), (10.0, 0.003, "unknown"),
])  # fmt: skip
def test_position_source_kind_is_guessed_from_noise_and_rate(rate_hz, sigma_m, kind) -> None:
    assert infer_position_kind(track(rate_hz, sigma_m).samples) == kind


def test_position_source_of_3_samples_has_unknown_kind() -> None:
    samples = pd.DataFrame(np.zeros((3, 3)), [0.0, 1.0, 2.0], Columns.POSITION)
    assert infer_position_kind(samples) == "unknown"
