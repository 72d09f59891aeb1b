"""Which mistakes the notes say that a flight has: rightly, wrongly, or so that nobody can tell."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from px4fuse.findings import named
from px4fuse.findings.causes import CONSEQUENCES
from px4fuse.grading.notes import Mention

# In the words of the rubric: what names a subject rather than a mistake
TOPICS = "topic"
# What a student rightly says of a mistake although it has a finding of its own
_BRINGS: Mapping[str, tuple[str, ...]] = {
    "source_gap": ("ekf2_not_fusing", "ekf2_rejecting"),
    "source_stamps_of_arrival": ("source_clock_offset",),
    "source_clock_changes": ("source_clock_offset", "source_stamps_of_arrival"),
}
# Told with an offset of the clock where both are there, but never its effect
_OF_ITS_OWN = frozenset(("source_stamps_of_arrival",))

_CONSEQUENCES = {
    cause: {one.partition(":")[0] for one in listed} for cause, listed in CONSEQUENCES.items()
}
_EFFECTS = {
    cause: {*_CONSEQUENCES.get(cause, ()), *_BRINGS.get(cause, ())}
    for cause in (*_CONSEQUENCES, *_BRINGS)
}
_CAUSES = {
    effect: {cause for cause, listed in _CONSEQUENCES.items() if effect in listed}
    for effect in set().union(*_CONSEQUENCES.values())
}


@dataclass(frozen=True)
class Claims:
    """What notes claim, against what a flight has.

    Attributes
    ----------
    right : frozenset of str
        Findings that are there and claimed plainly.
    unsure : mapping of str to str
        Findings that are there and mentioned, with the passage.
    open : mapping of str to str
        Findings that are there, with a passage that may claim or deny them.
    wrong : mapping of str to str
        Findings that are not there and are claimed plainly, with the passage: one per kind.
    unsure_wrong : mapping of str to str
        Findings that are not there and mentioned, with the passage.
    """

    right: frozenset[str]
    unsure: Mapping[str, str]
    open: Mapping[str, str]
    wrong: Mapping[str, str]
    unsure_wrong: Mapping[str, str]

    @property
    def count(self) -> int:
        """How many kinds of mistakes are claimed plainly."""
        return len(self.right) + len(self.wrong)

    @property
    def earned(self) -> frozenset[str]:
        """Findings that count as named.

        A subject ("the clock offset is 0.2 s") is as good as a claim where every subject that is
        touched upon is one: who touches upon all of them has claimed nothing.
        """
        return self.right if self.unsure_wrong else self.right | frozenset(self.unsure)


def claims_of(
    mention: Callable[[str], tuple[Mention | None, bool]],
    there: Collection[str],
    possible: Collection[str],
    excused: Collection[str],
) -> Claims:
    """Compare what notes say with what a flight has.

    Parameters
    ----------
    mention : callable
        What the notes say of a finding, and whether they only touch upon it.
    there : collection of str
        What the flight has.
    possible : collection of str
        What it might have.
    excused : collection of str
        What belongs to that, and may be said as well.
    """
    right: set[str] = set()
    unsure: dict[str, str] = {}
    open_: dict[str, str] = {}
    wrong: dict[str, str] = {}
    unsure_wrong: dict[str, str] = {}
    for finding in sorted({*there, *possible}):
        said, weak = mention(finding)
        if said is None or said.stance == "denied":
            continue
        plain = said.stance == "claimed" and not weak
        if finding in there:
            if plain:
                right.add(finding)
            elif said.stance == "claimed":
                unsure[finding] = said.passage
            else:
                open_[finding] = said.passage
        elif finding not in excused:
            if plain and finding not in family(wrong):
                wrong[finding] = said.passage
            elif not plain and said.stance == "claimed":
                unsure_wrong[finding] = said.passage
    return Claims(frozenset(right), unsure, open_, wrong, unsure_wrong)


def entailed(findings: Collection[str]) -> frozenset[str]:
    """Findings with what they bring with them, as far as that is not a mistake of its own."""
    return frozenset(findings) | (_reached(findings, _EFFECTS) - _OF_ITS_OWN)


def family(findings: Collection[str]) -> frozenset[str]:
    """Findings with what they bring with them and what brings them."""
    return _reached(findings, _EFFECTS) | _reached(findings, _CAUSES)


def _reached(starts: Collection[str], leads: Mapping[str, Collection[str]]) -> frozenset[str]:
    found, left = set(starts), list(starts)
    while left:
        new = set(leads.get(left.pop(), ())) - found
        found |= new
        left += new
    return frozenset(found)


def in_words(findings: Collection[str]) -> list[str]:
    """Their names, for a sentence."""
    return [named(one) for one in sorted(findings)]
