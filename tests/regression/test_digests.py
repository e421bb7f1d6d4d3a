import json

import pytest
import recorded_digests


@pytest.mark.slow
@pytest.mark.parametrize("name", recorded_digests.names())
def test_moves_and_renames_keep_every_number(name: str) -> None:
    """Episodes, replays, alignments and benches give the recorded numbers, bit by bit."""
    recorded = json.loads(recorded_digests.FILE.read_text())
    here = recorded_digests.environment()
    if recorded["environment"] != here:
        pytest.skip(f"last bits may differ: recorded with {recorded['environment']}, running with {here}")
    found = recorded_digests.digests_of(name)
    assert found == {part: recorded["digests"][part] for part in found}
