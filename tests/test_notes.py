"""Notes read sentence by sentence: what they claim, deny and leave open, in any language."""

import random

import pytest
from notes_samples import ENGLISH, FILLER, HONEST

from px4fuse.grading.evidence import FIELD
from px4fuse.grading.folding import folded
from px4fuse.grading.model import Reading
from px4fuse.grading.notes import Words, read_notes
from px4fuse.grading.rubric import read_rubric

RUBRIC = read_rubric(None).words
NAMES = ("negation", "doubt", "reassurance", "contrast")
KNOWN = Words(*(frozenset(map(folded, RUBRIC[name])) for name in NAMES))


def read(text, words=KNOWN, rules=None, **given):
    return read_notes(text, words, rules or Reading(), **{"terms": FIELD, **given})


def stance(text, *phrases, words=KNOWN):
    found = read(text, words).mention(phrases or ("outlier",))
    return None if found is None else found.stance


@pytest.mark.parametrize(
    ("said", "text"),
    [
        ("claimed", "There are outliers at 20 s."),
        ("claimed", "Outliers were found at 20 s and at 40 s."),
        ("claimed", "There is no gap, but there are many outliers at 20 s."),
        ("claimed", "I see no gap; the positions have outliers."),
        ("claimed", "The outliers lie 2 m off, which no noise explains."),
        ("claimed", "| t | what |\n|---|---|\n| 20 s | some outliers there |"),
        ("denied", "There are no outliers in this flight."),
        ("denied", "I did not find any outliers here."),
        ("denied", "The flight is without outliers at all."),
        ("denied", "Neither outliers were seen in it."),
        ("denied", "The outliers are negligible in this flight."),
        ("open", "Outliers were not seen in this flight."),
        ("open", "The outliers are not many."),
        ("open", "Are there any outliers in it?"),
        ("open", "If there were outliers then I would see them."),
        ("open", "I checked the flight for outliers."),
        ("open", "There might be outliers at 20 s."),
        ("open", "There is no gap, outliers or jumps."),
        (None, "The filter works well in this flight."),
        (None, "Outliers. Gap."),
        ("claimed", "There are no outliers. At 40 s there are outliers."),
    ],
)
def test_what_a_sentence_says(said, text):
    assert stance(text) == said


def test_words_of_a_phrase_stand_in_one_sentence():
    text = "The clock is good here. Positions come late.\n\n- Stamps are 0.2 s later"
    assert stance(text, "clock late") is None
    assert stance(text, "stamp late") == "claimed"
    assert stance(text, "positions late", "clock late") == "claimed"


def test_a_phrase_that_denies_keeps_its_words_together():
    assert stance("The loop is not closed at all.", "not closed") == "claimed"
    apart = "It did not drift, and the loop closed well."
    assert stance(apart, "not closed") is None


def test_words_that_deny_are_the_rubric_s():
    german = Words(frozenset(("keine", "nicht")), frozenset(("vielleicht",)), frozenset(),
                   frozenset(("aber",)))  # fmt: skip
    assert stance("Es gibt keine Ausreißer im Flug.", "ausreisser", words=german) == "denied"
    assert stance("Es gibt vielleicht Ausreißer im Flug.", "Ausreißer", words=german) == "open"
    assert stance("Es gibt Ausreißer bei 20 s im Flug.", "Ausreißer", words=german) == "claimed"
    assert stance("测量中有野值，它们在20 s。", "野值") == "claimed"


@pytest.mark.parametrize("language", HONEST)
def test_honest_notes_are_notes_in_every_language(language):
    made = read(HONEST[language])
    assert made.problem == ""
    assert made.words > 75
    assert made.disguised == 0
    # and in any part of them
    sentences = [one.text for one in made.sentences]
    rng = random.Random(0)
    for _ in range(20):
        start = rng.randrange(len(sentences) - 2)
        assert read("\n\n".join(sentences[start : start + 3])).problem == ""


@pytest.mark.parametrize("name", FILLER)
def test_filler_is_none(name):
    assert "nothing about the flight" in read(FILLER[name]).problem


RULES = {
    "in_sentences": ("not sentences", " ".join(f"word{n}" for n in range(100)), 0.0),
    "packed": (
        "again and again",
        " ".join(f"The UWB sends a position in pass {n} of it." for n in range(60)), 0.0,
    ),
    "common": ("small ones", ". ".join(f"uwb{n} b{n} c{n} d{n} e{n}" for n in range(40)), 0.0),
    "commonest": (
        "one word", ". ".join(f"the w{n} the uwb{n} the {n**3} the x{n}" for n in range(40)), 1.0,
    ),
    "terms": (
        "words for mistakes",
        ". ".join(f"the uwb{n} of imu{n} and nis{n} a ekf{n} is gps{n}" for n in range(40)), 1.0,
    ),
    "about": ("nothing about the flight", FILLER["story"], 0.0),
}  # fmt: skip


@pytest.mark.parametrize("name", RULES)
def test_every_rule_decides_and_can_be_relaxed(name):
    said, text, relaxed = RULES[name]
    assert said in read(text).problem
    assert said not in read(text, rules=Reading(**{name: relaxed})).problem


def test_ids_and_quotes():
    ids = {"source_gap", "source_outliers", "no_motion"}
    pasted = " ".join(ids) + " and more of them: " + (" ".join(sorted(ids)) + " ") * 9
    assert "names of findings" in read(pasted, ids=ids).problem
    theirs = ("The stamps of the UWB are late by 0.25 s against the IMU, which no filter shows.",)
    copied = theirs[0].replace("0.25", "0.31")
    assert read(copied * 3, theirs=theirs).problem == "are mostly sentences of px4fuse itself"
    numbers = ("From 20 s to 25 s there are 14 of 600 samples 2 m beside the track here.",)
    others = "From 21 s to 24 s there are 15 of 601 samples 3 m beside the track here."
    assert read(others * 2, theirs=numbers).sentences == ()
    mixed = f"{ENGLISH}\n\n{copied}"
    made = read(mixed, theirs=theirs)
    assert (made.problem, made.quoted) == ("", 18)
    assert made.words == read(ENGLISH).words
    # what is cut into sentences where px4fuse has none is of px4fuse all the same
    remedy = "Let EKF2 fuse the yaw of the source (EKF2_EV_CTRL bit 3; EKF2_AID_MASK bit 4)."
    assert read(f"{ENGLISH}\n\n{remedy}", theirs=(remedy,)).sentences == read(ENGLISH).sentences
    assert read(f"{ENGLISH} The mask was set to bit 4.", theirs=(remedy,)).words > made.words


def test_what_a_page_does_not_show_is_not_read():
    hidden = "<!-- There are outliers at 20 s. -->\n\n[a]: http://b 'There are outliers at 20 s.'"
    assert read(hidden).words == 0
    assert read("A `code` with outliers at **20 s** is read.").words == 9


def test_greek_and_cyrillic_capitals_are_folded():
    assert folded("ΒΟΤΗ ΝΙЅ, Ιnnovation") == "both nis, innovation"
    assert folded("٢٥ ２５ ㎳") == "25 25 ms"


def test_disguised_words():
    text = "The оutliers are аt 20 s, and the pоsitions cоme late, out\u200bliers too."
    made = read(text)
    assert made.disguised == 4
    assert made.mention(["outlier"]).stance == "claimed"
