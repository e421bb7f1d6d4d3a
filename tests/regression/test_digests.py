import json

import pytest
import recorded_digests


@pytest.mark.slow
def test_moves_and_renames_keep_every_number() -> None:
    """Episodes, replays, alignments and benches give the recorded numbers, bit by bit."""
    recorded = json.loads(recorded_digests.FILE.read_text())
    here = recorded_digests.environment()
    if recorded["environment"] != here:
        pytest.skip(f"last bits may differ: recorded with {recorded['environment']}, running with {here}")
    found = recorded_digests.all_digests()
    assert found == {name: recorded["digests"][name] for name in found}
