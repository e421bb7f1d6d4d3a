"""Losses of teams: the ideal team, the waits for its merges, and the study."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam_backend.maps.alignment import Alignment
from slam_backend.team.reports import MergeEvent
from studies.bounds.episodes import record_episode
from studies.bounds.ideal_team import NO_CONTACT, NOT_TRIED, SHARED, ideal_merges, ideal_team, waits_by_reason
from studies.filters.losses import environment
from studies.merging.team_losses import STUDY, Config, play, trials
from training.bench.exploration.players import parted
from vslam_env import vslam_v1

SMALL = Config(worlds=("fig5",), duration=4.0, particles=(12,), robots=(2,), policies=("frontier",), seeds=1, seed=70)
FOUND = Alignment(True, "", 0.0, 0.0, 0.0, np.eye(3), np.empty((0, 2), np.int64), 0.0)


def team_of(named: list[list[list[int]]], contacts: list[bool]) -> Any:
    """Return an episode of two robots with these true landmarks and contacts by tick."""
    ids = tuple(tuple(np.array(own, np.int64) for own in tick) for tick in named)
    rows = [np.array([[True, near], [near, True]]) for near in contacts]
    readings = tuple(tuple(SimpleNamespace(contacts=own) for own in row) for row in rows)
    return SimpleNamespace(true_ids=ids, readings=readings, true_paths=np.zeros((2, len(named), 3)))


def test_the_ideal_team_merges_with_enough_landmarks_and_contact() -> None:
    """Eight common landmarks suffice, false points are none, and without contact the team waits."""
    few, all_of_them = list(range(SHARED - 1)), list(range(SHARED))
    named = [[all_of_them, few], [[-1], [-1]], [[], [SHARED - 1]], [[], []]]
    assert ideal_merges(team_of(named, [True] * 4)) == [(2, (0,), (1,))]
    assert ideal_merges(team_of(named, [True, True, False, True])) == [(3, (0,), (1,))]
    assert ideal_merges(team_of(named[:2], [True] * 2)) == []


def test_waits_are_named_by_the_last_refusal() -> None:
    """Before any attempt contact or its absence count; a merge ends the wait, and an undone one does not."""
    episode = team_of([[[], []]] * 10, [True, False, *[True] * 8])
    ideal = [(1, (0,), (1,))]
    refused = MergeEvent(4, "attempt", (0,), (1,), Alignment.refused("too uncertain", 0.0, "paths", 2.0))
    merge = MergeEvent(7, "merge", (0,), (1,), FOUND)
    undo = MergeEvent(8, "undo", (0,), (1,), FOUND)
    assert waits_by_reason(episode, ideal, [refused, merge]) == {NO_CONTACT: 1, NOT_TRIED: 2, "too uncertain: paths": 3}
    assert waits_by_reason(episode, ideal, [replace(merge, step=1)]) == {}
    assert waits_by_reason(episode, [(8, (0,), (1,))], [merge, undo]) == {NOT_TRIED: 2}


def test_the_ideal_team_knows_its_landmarks_without_noise() -> None:
    """With nearly exact readings its map errors are those of the landmarks that were not measured twice."""
    (trial,) = trials(SMALL)
    sensor = {"camera": {"sigma_px": 1e-3, "sigma_disparity_px": 1e-3}, "false_points": 0.0}
    env = vslam_v1.parallel_env(config=environment(SMALL, trial).replace(landmark_sensor=sensor, comm_loss=0.0))
    episode = record_episode(env, parted(trial.policy).make(env, 600.0), trial.seed)
    env.close()
    team = ideal_team(episode)
    group = [{0, 1}, {0, 1}] if team.merges else [{0}, {1}]
    for robot, error in enumerate(team.map_errors):
        seen = np.concatenate([tick[other] for tick in episode.true_ids for other in group[robot]])
        names, counts = np.unique(seen, return_counts=True)
        held = np.isin(episode.observable, names[counts >= episode.config.belief.confirm_after]).sum()
        missed = 1.0 - held / len(episode.observable)
        assert error == pytest.approx(np.sqrt(0.5 * missed) * episode.config.map_error_cutoff, abs=1e-3)


def test_the_study_compares_errors_and_merges() -> None:
    """A trial has all that the table shows, and waits only for merges of the ideal team."""
    (trial,) = trials(SMALL)
    row = play(SMALL, trial)
    assert row["excess"] == pytest.approx(row["map_error"] - row["ideal_map_error"])
    assert 0.0 < row["ideal_map_error"] < 1.0
    assert row["wait_s"] == pytest.approx(sum(row["waits"].values()))
    assert row["ideal_merges"] > 0 or not row["waits"]
    waits = {"too uncertain: paths": 2.0, "too uncertain: rotation": 1.0, "too few inliers": 0.5}
    rows = [{"preset": "hard", "world": "fig5", "robots": 2} | row | {"waits": waits, "wait_s": 3.5}] * 2
    (line,), (parts,) = (table.lines(rows) for table in STUDY.tables)
    assert line["merges"].value == row["merges"]
    assert [parts[name].value for name in ("all [s]", "paths [s]", "landmarks [s]", "few inliers [s]")] == [
        3.5, 2.0, 1.0, 0.5,
    ]  # fmt: skip
