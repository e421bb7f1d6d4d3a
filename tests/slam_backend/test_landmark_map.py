import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.geometry import compose, inverse
from slam_backend.maps.landmark_map import FIELDS, LandmarkMap, unchecked_map

N, D = 5, 7


def fields(seed: int = 0) -> dict[str, Any]:
    """Five landmarks with descriptors of size seven, every value different."""
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((N, 3, 3))
    return {
        "means": rng.uniform(-9.0, 9.0, (N, 3)),
        "covariances": roots @ roots.transpose(0, 2, 1),
        "descriptors": rng.standard_normal((N, D)).astype(np.float32),
        "counts": rng.integers(1, 20, N),
        "ids": rng.permutation(30)[:N],
    }


def assert_same(one: LandmarkMap, other: LandmarkMap) -> None:
    """Every array of both maps agrees bit for bit."""
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_arrays_are_read_only_copies() -> None:
    """A map neither follows later changes of its inputs nor lets itself be changed."""
    given_fields = fields()
    m = LandmarkMap(**given_fields)
    given_fields["means"][0] = 99.0
    assert m.means[0, 0] != 99.0
    for name in FIELDS:
        with pytest.raises(ValueError, match="read-only"):
            getattr(m, name)[0] = 0
    with pytest.raises(dataclasses.FrozenInstanceError, match="means"):
        m.means = np.zeros((N, 3))  # type: ignore[misc]


def test_defaults_are_ones_and_a_running_number() -> None:
    """Without counts and ids, each landmark counts once and is named by its row."""
    f = fields()
    m = LandmarkMap(f["means"], f["covariances"], f["descriptors"])
    assert m.counts.tolist() == [1] * N
    assert m.ids.tolist() == list(range(N))
    assert (len(m), len(LandmarkMap.empty(D))) == (N, 0)
    assert (m.means.dtype, m.descriptors.dtype, m.counts.dtype) == (np.float64, np.float32, np.int64)


poses = st.tuples(*(st.floats(-50.0, 50.0),) * 2, st.floats(-10.0, 10.0)).map(np.array)


@given(pose=poses, second=poses)
def test_moving_is_a_group_action(pose: np.ndarray, second: np.ndarray) -> None:
    """Moving by two motions in turn is moving by their composition, and moving back restores the map."""
    m = LandmarkMap(**fields())
    twice, once = m.moved(second).moved(pose), m.moved(compose(pose, second))
    back = m.moved(pose).moved(inverse(pose))
    for name in ("means", "covariances"):
        np.testing.assert_allclose(getattr(twice, name), getattr(once, name), atol=1e-9)
        np.testing.assert_allclose(getattr(back, name), getattr(m, name), atol=1e-9)


def test_moving_rotates_the_ellipse_with_the_landmark() -> None:
    """A landmark uncertain along x is uncertain along y after a quarter turn."""
    m = LandmarkMap([[2.0, 0.0, 0.5]], [np.diag([4.0, 1.0, 0.25])], np.ones((1, D)))
    moved = m.moved([1.0, 1.0, np.pi / 2])
    np.testing.assert_allclose(moved.means, [[1.0, 3.0, 0.5]], atol=1e-12)
    np.testing.assert_allclose(moved.covariances, [np.diag([1.0, 4.0, 0.25])], atol=1e-12)


def test_subset_takes_rows_in_order_or_by_mask() -> None:
    """A subset is the same whether asked for by integers or by a mask."""
    m = LandmarkMap(**fields())
    assert m.subset([3, 1]).ids.tolist() == [m.ids[3], m.ids[1]]
    assert_same(m.subset([1, 3]), m.subset(np.array([False, True, False, True, False])))
    assert len(m.subset([])) == 0


def test_trusted_maps_equal_checked_ones() -> None:
    """The unchecked constructor of the hot loop builds the same map, and protects it from writes through itself."""
    f = fields()
    trusted = unchecked_map(**f)
    assert_same(trusted, LandmarkMap(**f))
    with pytest.raises(ValueError, match="read-only"):
        trusted.means[0] = 0.0


def test_saved_maps_load_bit_for_bit(tmp_path: Path) -> None:
    """What is saved, under exactly the given name, comes back unchanged; so does an empty map."""
    for m in (LandmarkMap(**fields()), LandmarkMap.empty(D)):
        path = tmp_path / "a map without suffix"
        m.save(path)
        assert path.is_file()
        assert_same(m, LandmarkMap.load(path))


def test_damaged_files_never_load_as_another_map(tmp_path: Path) -> None:
    """A file cut short or with a changed byte gives the clear error, or still the same map."""
    m = LandmarkMap(**fields())
    path = tmp_path / "map.npz"
    m.save(path)
    content = path.read_bytes()
    rng = np.random.default_rng(3)
    outcomes = []
    for trial in range(150):
        damaged = bytearray(content)
        position = int(rng.integers(len(content)))
        if trial % 3 == 0:
            damaged = damaged[:position]
        else:
            damaged[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(damaged))
        try:
            assert_same(m, LandmarkMap.load(path))
        except ValueError as error:
            outcomes.append(str(error))
    assert len(outcomes) > 100
    assert all(o.startswith("path: expected") for o in outcomes)


def test_files_of_another_kind_are_refused(tmp_path: Path) -> None:
    """Missing files, text, foreign archives and newer versions are each refused with one clear error."""
    with pytest.raises(ValueError, match=r"path: expected a file written by LandmarkMap.save, got no such file"):
        LandmarkMap.load(tmp_path / "missing.npz")
    text, array, foreign = tmp_path / "a.txt", tmp_path / "a.npy", tmp_path / "a.npz"
    text.write_text("not a map")
    np.save(array, np.arange(3))
    np.savez(foreign, means=np.zeros((2, 3)))
    for path in (text, array, foreign):
        with pytest.raises(ValueError, match="got a broken file"):
            LandmarkMap.load(path)
    newer = fields() | {"format": np.array("vslam landmark map"), "version": np.array(2)}
    np.savez(foreign, **newer)
    with pytest.raises(ValueError, match="expected 'vslam landmark map' version 1, got 'vslam landmark map' version 2"):
        LandmarkMap.load(foreign)


ASYMMETRIC = np.tile(np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), (N, 1, 1))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", np.zeros((N, 2)), r"means: expected an array of shape \(n, 3\), got shape \(5, 2\)"),
        ("means", np.full((N, 3), np.nan), "means: expected finite numbers, got NaN or infinity at index"),
        ("covariances", np.zeros((N, 2, 2)), r"covariances: expected an array of shape \(5, 3, 3\)"),
        ("covariances", ASYMMETRIC, "covariances: expected symmetric matrices"),
        ("covariances", np.tile(np.diag([1.0, 1.0, -0.1]), (N, 1, 1)), "expected positive semi-definite matrices"),
        ("descriptors", np.zeros((N + 1, D)), "descriptors: expected an array of shape"),
        ("counts", [1, 1, 0, 1, 1], "counts: expected integers >= 1"),
        ("counts", [1, 1, 1.5, 1, 1], "counts: expected integers >= 1"),
        ("counts", "many", "counts: expected an array of shape"),
        ("ids", [0, 1, 2, 3, 3], "ids: expected unique ids, got a repeated id 3"),
        ("ids", [0, 1, -1, 2, 3], "ids: expected integers >= 0"),
    ],
)
def test_bad_input_gives_one_clear_error(name: str, value: Any, message: str) -> None:
    """Each wrong field is refused by name, with what was expected and what came."""
    with pytest.raises(ValueError, match=message):
        LandmarkMap(**(fields() | {name: value}))


@pytest.mark.parametrize("indices", [[5], [-1], [0, 0], [0.5], [[0]], np.ones(3, bool)])
def test_bad_subsets_are_refused(indices: Any) -> None:
    """Rows that do not exist, repeat or are no integers are refused."""
    with pytest.raises(ValueError, match="indices: expected"):
        LandmarkMap(**fields()).subset(indices)


def test_rank_deficient_covariances_are_accepted() -> None:
    """A landmark whose height is known exactly has a singular covariance, which is no error."""
    assert len(LandmarkMap(np.zeros((1, 3)), [np.diag([1.0, 2.0, 0.0])], np.ones((1, D)))) == 1
