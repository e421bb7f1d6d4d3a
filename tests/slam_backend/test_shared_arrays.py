"""States share arrays with running filters and teams: they are read-only."""

import copy
import pickle

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.shared_arrays import scribble, shared, shared_and_writable
from test_damaged_states import SUBJECTS, play

from slam_backend.core.read_only import as_constant, as_read_only, is_read_only, with_read_only
from slam_backend.state.codec import decode, encode


@pytest.mark.parametrize("name", SUBJECTS)
def test_arrays_shared_by_a_state_are_read_only(name: str) -> None:
    """That holds for states of filters and teams, among each other as well, and for those that they are set to."""
    subject, _ = SUBJECTS[name]()
    state = subject.get_state()
    assert shared(state, subject)
    assert not shared_and_writable(state, subject)
    assert not shared_and_writable(state, subject.get_state())
    read = decode(encode(state))
    for other in (pickle.loads(pickle.dumps(state)), copy.deepcopy(state), read, state):
        subject.set_state(other)
        assert not shared_and_writable(other, subject)


@pytest.mark.parametrize("name", SUBJECTS)
def test_what_is_written_into_a_state_changes_nothing(name: str) -> None:
    """A filter or a team goes on alike when all that can be written of a state that it was set to is spoilt."""
    subject, readings = SUBJECTS[name]()
    start = subject.get_state()
    play(subject, readings)
    end = subject.get_state()
    for other in (pickle.loads(pickle.dumps(start)), copy.deepcopy(start)):
        subject.set_state(other)
        assert scribble(other) > 0
        play(subject, readings)
        assert_same(subject.get_state(), end)
    assert scribble(end) == 0


def test_parts_of_trees_are_copied_only_where_they_can_be_written() -> None:
    """A part in which nothing can be written comes back itself, so that what was checked is not looked at again."""
    own = np.arange(3.0)
    fixed = as_read_only(own)
    assert as_read_only(fixed) is as_constant(fixed) is fixed
    tree = {"fixed": (fixed, [fixed[1:], 1]), "own": (own, "text")}
    result = with_read_only(tree)
    assert result["fixed"] is tree["fixed"]
    assert is_read_only(result["own"][0])
    assert np.shares_memory(result["own"][0], own)
    assert tree["own"][0] is own
    own.setflags(write=False)
    assert not is_read_only(own)  # its owner can take that back
