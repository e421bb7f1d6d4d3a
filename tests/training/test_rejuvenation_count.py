"""How replays count what came of drawing particles anew, and how they tell it."""

from slam_backend.fastslam.reports import RejuvenationReport
from training.replay.rejuvenation_counts import RejuvenationCount, sentence_of


def count_of(*reasons: str | None) -> RejuvenationCount:
    """Return the count of attempts with these reasons; None: a step without any."""
    count = RejuvenationCount()
    for reason in reasons:
        count.add(None if reason is None else RejuvenationReport(reason, 1.0, 1, 1))
    return count


def test_refusals_are_told_apart_by_their_words() -> None:
    """Numbers within a reason do not make it another one, and steps without an attempt do not count."""
    sizes = [f"an effective sample size of {size}" for size in ("1.5", "29.9")]
    found = count_of("", *sizes, None, "", "no convergence in 15 iterations").to_mapping()
    refused = {"an effective sample size of n": 2, "no convergence in n iterations": 1}
    assert found == {"drawn": 2, "refused": refused}


def test_the_sentence_tells_all_there_is() -> None:
    """Draws alone, draws and refusals, and nothing where nothing was attempted."""
    assert sentence_of(count_of(None).to_mapping()) == ""
    assert sentence_of(count_of("", "").to_mapping()) == "Particles were drawn anew 2 times."
    told = sentence_of(count_of("no pose to seek", "").to_mapping())
    assert told == "Particles were drawn anew 1 times, and not, for: no pose to seek (1)."
