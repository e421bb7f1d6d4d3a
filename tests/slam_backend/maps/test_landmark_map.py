"""Maps, frames of measurements and the archives that hold them."""

import copy
import dataclasses
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.damage import Trap
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.core.array_files import UnreadableArchiveError, read_arrays
from slam_backend.geometry import compose, inverse
from slam_backend.maps.landmark_map import FIELDS, LandmarkMap, unchecked_map
from slam_backend.models.measurements import Measurements, TeamMeasurements

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


def test_clouds_and_tables_hold_what_other_programs_read(tmp_path: Path) -> None:
    """A PLY has position, count and the root of the covariance's trace of each landmark; a CSV exact numbers."""
    m = LandmarkMap(**fields())
    m.save(tmp_path / "map.PLY")
    header, _, body = (tmp_path / "map.PLY").read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", f"element vertex {len(m)}"]
    assert lines[3:] == [f"property float {name}" for name in ("x", "y", "z", "count", "sigma")]
    rows = np.frombuffer(body, "<f4").reshape(len(m), 5)
    sigma = np.sqrt(np.trace(m.covariances, axis1=1, axis2=2))
    np.testing.assert_allclose(rows, np.column_stack([m.means, m.counts, sigma]), rtol=1e-6)
    m.save(tmp_path / "map.csv")
    table = np.genfromtxt(tmp_path / "map.csv", delimiter=",", names=True)
    assert np.array_equal(np.column_stack([table[f"{axis}_m"] for axis in "xyz"]), m.means)
    LandmarkMap.empty(D).save(tmp_path / "none.ply")
    assert b"element vertex 0\n" in (tmp_path / "none.ply").read_bytes()


def test_other_suffixes_are_refused(tmp_path: Path) -> None:
    """A suffix that names no format of maps is refused, and nothing is written."""
    with pytest.raises(ValueError, match=r"path: expected a name that ends in \.npz, \.csv or \.ply, got .*map\.pcd"):
        LandmarkMap(**fields()).save(tmp_path / "map.pcd")
    assert not list(tmp_path.iterdir())


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
    """Missing files, text, foreign archives, pickles and newer versions are each refused with one clear error."""
    with pytest.raises(
        ValueError, match=r"path: expected a map \(.npz\) that LandmarkMap.save wrote, got no such file"
    ):
        LandmarkMap.load(tmp_path / "missing.npz")
    text, array, foreign = tmp_path / "a.txt", tmp_path / "a.npy", tmp_path / "a.npz"
    text.write_text("not a map")
    np.save(array, np.arange(3))
    np.savez(foreign, means=np.zeros((2, 3)))
    for path, cure in ((text, ": only .npz is read back."), (array, ": only .npz is read back."), (foreign, ".")):
        with pytest.raises(ValueError, match=f"got a file of another kind. Check '{path}'{cure}$"):
            LandmarkMap.load(path)
    proof = tmp_path / "proof"
    forged = fields() | {"means": np.array([Trap(proof)], dtype=object), "format": np.array("vslam landmark map")}
    np.savez(foreign, allow_pickle=True, **forged | {"version": np.array(1)})
    with pytest.raises(ValueError, match="got a broken file"):
        LandmarkMap.load(foreign)
    assert not proof.exists()
    np.savez(foreign, **fields(), format=np.array("vslam landmark map"), version=np.array(np.inf))
    with pytest.raises(ValueError, match="got a broken file"):
        LandmarkMap.load(foreign)
    newer = fields() | {"format": np.array("vslam landmark map"), "version": np.array(2)}
    np.savez(foreign, **newer)
    with pytest.raises(ValueError, match="expected 'vslam landmark map' version 1, got 'vslam landmark map' version 2"):
        LandmarkMap.load(foreign)


def test_rank_deficient_covariances_are_accepted() -> None:
    """A landmark whose height is known exactly has a singular covariance, which is no error."""
    assert len(LandmarkMap(np.zeros((1, 3)), [np.diag([1.0, 2.0, 0.0])], np.ones((1, D)))) == 1


POINTS = [[0.0, 0.1, 2.0], [1.0, 0.0, 3.0]]
LOOKS = np.eye(2, 5, dtype=np.float32)


def test_frames_share_no_memory_and_cannot_be_written() -> None:
    """The arrays are copies and read-only, so a caller cannot change what a filter has accepted."""
    points = np.array(POINTS)
    frame = Measurements(points, LOOKS, np.tile(np.eye(3), (2, 1, 1)))
    points[:] = 9.0
    np.testing.assert_array_equal(frame.points, POINTS)
    for array in (frame.points, frame.descriptors, frame.covariances):
        assert array is not None
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0
    assert (len(frame), frame.points.dtype, frame.descriptors.dtype) == (2, np.float64, np.float32)


def test_copies_cannot_be_written_either() -> None:
    """Deep copies and loaded copies, of frames and of parts of a team's frames, are read-only."""
    frame = Measurements(POINTS, LOOKS, np.tile(np.eye(3), (2, 1, 1)))
    team = TeamMeasurements(np.array(POINTS), LOOKS.copy(), np.array([1, 2]))
    for one in (frame, team.per_robot()[1]):
        for other in (copy.copy(one), copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
            assert getattr(other, "extent", None) == getattr(one, "extent", None)
            for name in ("points", "descriptors", "covariances"):
                array, own = getattr(one, name, None), getattr(other, name, None)
                np.testing.assert_array_equal(own, array)
                assert own is None or not own.flags.writeable


def test_an_empty_frame_is_valid() -> None:
    """An empty frame has no rows and its descriptor size."""
    frame = Measurements.empty(11)
    assert (len(frame), frame.points.shape, frame.descriptors.shape) == (0, (0, 3), (0, 11))


def test_an_extent_bounds_all_points() -> None:
    """It is tight, of frames that were cut out of a team's as well; an empty one bounds nothing."""
    rng = np.random.default_rng(100)
    points, looks = rng.normal(0.0, 3.0, (7, 3)), np.zeros((7, 5), np.float32)
    frame = Measurements(points, looks)
    assert frame.extent == (points[:, 2].min(), np.abs(points).max())
    assert copy.deepcopy(frame).extent == frame.extent
    assert Measurements.empty().extent == (np.inf, 0.0)
    for part in TeamMeasurements(points, looks, np.array([3, 3, 7])).per_robot():
        assert part.extent == (part.points[:, 2].min(initial=np.inf), np.abs(part.points).max(initial=0.0))


def test_covariances_within_the_limits_are_taken_as_they_are() -> None:
    """A micrometre beside a centimetre in any direction is no reason for an error, nor is a frame without points."""
    root = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    covariance = root @ np.diag([2e-12, 1e-4, 3e-7]) @ root.T
    covariance = 0.5 * (covariance + covariance.T)
    frame = Measurements(POINTS, LOOKS, [covariance] * 2)
    np.testing.assert_array_equal(frame.covariances, [covariance] * 2)
    assert len(Measurements(np.empty((0, 3)), np.empty((0, 5)), np.empty((0, 3, 3)))) == 0


def header(shape: str, descr: str = "<f8") -> bytes:
    """Return the beginning of an array's file."""
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def archive(file: Path, content: bytes, compressed: bool = False) -> Path:
    """Write an archive of one member."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED) as out:
        out.writestr("a.npy", content)
    return file


def test_archives_round_trip(tmp_path: Path) -> None:
    """Plain and compressed archives of numbers and texts are read, all of them or some."""
    arrays = {
        "a": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "b": np.array("text"),
        "c": np.zeros((0, 3), np.int8),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "x.npz", **arrays)
        found = read_arrays(tmp_path / "x.npz")
        assert list(found) == ["a", "b", "c"]
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array)
            assert (found[name].dtype, found[name].flags.writeable) == (array.dtype, True)
        assert list(read_arrays(tmp_path / "x.npz", ["b", "d"])) == ["b"]


def test_pickles_in_archives_are_not_run(tmp_path: Path) -> None:
    """An array of objects would be a pickle."""
    proof = tmp_path / "proof"
    np.savez(tmp_path / "x.npz", allow_pickle=True, a=np.array([Trap(proof)], dtype=object))
    with pytest.raises(UnreadableArchiveError, match=r"a\.npy holds object"):
        read_arrays(tmp_path / "x.npz")
    assert not proof.exists()


@pytest.mark.parametrize(
    ("content", "compressed", "says"),
    [
        (header("(1000000000000,)"), False, r"says that it has the shape \(1000000000000,\)"),
        (header("(-5,)") + bytes(40), False, "says that it has the shape"),
        (header("(3,)") + bytes(16), False, "says that|has 16 bytes of 24"),
        (header("(3,)") + bytes(16), True, "says that|has 16 bytes of 24"),
        (header("(1,)", "|V8") + bytes(8), False, "holds"),
        (b"no array at all", False, "."),
        (header("(__import__('os').getpid(),)") + bytes(8), False, "."),
    ],
)
def test_forged_arrays_are_refused(content: bytes, compressed: bool, says: str, tmp_path: Path) -> None:
    """What a header promises and the file does not hold is refused before there is room for it."""
    with pytest.raises(UnreadableArchiveError, match=says):
        read_arrays(archive(tmp_path / "x.npz", content, compressed))


def test_archives_that_unpack_to_too_much_are_refused(tmp_path: Path) -> None:
    """Of a member that would be gigabytes nothing is unpacked, whatever its size in the file."""
    file = tmp_path / "bomb.npz"
    with (
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as out,
        out.open("a.npy", "w", force_zip64=True) as member,
    ):
        member.write(header("(150000000,)"))
        for _ in range(1200):
            member.write(bytes(1_000_000))
    assert file.stat().st_size < 10_000_000
    with pytest.raises(UnreadableArchiveError, match="unpacks to more than 1024 MiB"):
        read_arrays(file)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_archives_that_are_compressed_otherwise_are_refused(method: int, tmp_path: Path) -> None:
    """Of such a member all would be unpacked, whatever size it claims: 2 kB can become gigabytes."""
    with zipfile.ZipFile(tmp_path / "x.npz", "w", method) as out:
        out.writestr("a.npy", header("(3,)") + bytes(24))
    with pytest.raises(UnreadableArchiveError, match=r"a\.npy is compressed by another method than numpy's"):
        read_arrays(tmp_path / "x.npz")
