import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_backend.core.array_files import UnreadableArchiveError, read_arrays
from slam_backend.maps.landmark_map import LandmarkMap


class Trap:
    """What a pickle of makes a file when it is read."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> Any:
        return Path.touch, (self.file,)


def header(shape: str, descr: str = "<f8") -> bytes:
    """Return the beginning of an array's file."""
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def archive(file: Path, content: bytes, compressed: bool = False) -> Path:
    """Write an archive of one member."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED) as out:
        out.writestr("a.npy", content)
    return file


def test_archives_come_back(tmp_path: Path) -> None:
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


def test_maps_that_are_forged_run_nothing(tmp_path: Path) -> None:
    """A map whose arrays are pickles, or whose format is another, is refused."""
    proof, file = tmp_path / "proof", tmp_path / "map.npz"
    LandmarkMap([[1.0, 2.0, 0.0]], [np.eye(3)], [[1.0, 0.0]]).save(file)
    arrays = read_arrays(file)
    with file.open("wb") as out:
        np.savez(out, allow_pickle=True, **arrays | {"means": np.array([Trap(proof)], dtype=object)})
    with pytest.raises(ValueError, match=r"path: expected a file written by LandmarkMap\.save, got a broken file"):
        LandmarkMap.load(file)
    assert not proof.exists()
    with file.open("wb") as out:
        np.savez(out, **arrays | {"version": np.array(2)})
    with pytest.raises(ValueError, match="expected 'vslam landmark map' version 1, got 'vslam landmark map' version 2"):
        LandmarkMap.load(file)
    file.write_bytes(io.BytesIO(b"PK").getvalue())
    with pytest.raises(ValueError, match="a broken file"):
        LandmarkMap.load(file)
