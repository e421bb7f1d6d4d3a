"""Output files: what is there decides whether a file is renamed onto it or written into it."""

import errno
import os
import stat
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from builders.full_disk import files_up_to

from slam_backend.core import files
from slam_backend.core.files import append_text, check_writable, move_file, write_file

pytestmark = pytest.mark.skipif(os.name != "posix", reason="devices, FIFOs and modes are POSIX")

Writer = Callable[[Path, str], None]


def _moved(path: Path, text: str) -> None:
    part = path.parent / "finished"
    part.write_text(text)
    move_file(part, path)
    assert not part.exists()


WRITERS = [pytest.param(write_file, id="write_file"), pytest.param(_moved, id="move_file")]


@pytest.mark.parametrize("write", WRITERS)
def test_a_file_is_replaced_and_keeps_its_mode_and_owner(write: Writer, tmp_path: Path) -> None:
    """A reader of the old file reads on in the old one; the new one has the old mode and owner."""
    path = tmp_path / "file"
    path.write_text("old")
    path.chmod(0o604)
    if os.geteuid() == 0:
        os.chown(path, 12345, 54321)
    before = path.stat()
    with path.open() as reader:
        write(path, "new")
        assert reader.read() == "old"
    assert path.read_text() == "new"
    after = path.stat()
    assert after.st_ino != before.st_ino
    assert (after.st_mode, after.st_uid, after.st_gid) == (before.st_mode, before.st_uid, before.st_gid)
    assert list(tmp_path.iterdir()) == [path]


def test_a_new_file_follows_the_umask(tmp_path: Path) -> None:
    """Who may read a new file follows from the process' umask."""
    former = os.umask(0o027)
    try:
        write_file(tmp_path / "file", b"new")
    finally:
        os.umask(former)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("there", [True, False])
def test_links_are_followed(write: Writer, there: bool, tmp_path: Path) -> None:
    """A link to a link stays what it is, and the file that it leads to is written, also where there is none yet."""
    (tmp_path / "far").mkdir()
    target, link, other = tmp_path / "far" / "file", tmp_path / "link", tmp_path / "other"
    if there:
        target.write_text("old")
    link.symlink_to(other)
    other.symlink_to("far/file")
    check_writable(link, "json")
    write(link, "new")
    assert (link.is_symlink(), other.is_symlink(), target.is_symlink()) == (True, True, False)
    assert target.read_text() == "new"
    assert list((tmp_path / "far").iterdir()) == [target]


@pytest.mark.parametrize("write", WRITERS)
def test_a_fifo_is_written_and_not_replaced(write: Writer, tmp_path: Path) -> None:
    """What reads a FIFO reads all that was written; it may come a little later."""
    path = tmp_path / "fifo"
    os.mkfifo(path)
    check_writable(path, "json")
    text, read = "x" * 300_000, []
    reader = threading.Timer(0.1, lambda: read.append(path.read_text()))
    reader.start()
    write(path, text)
    reader.join()
    assert read == [text]
    assert stat.S_ISFIFO(path.stat().st_mode)


def test_a_fifo_that_nothing_reads_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Writing does not wait for a reader."""
    monkeypatch.setattr(files, "READER_S", 0.05)
    path = tmp_path / "fifo"
    os.mkfifo(path)
    with pytest.raises(ValueError, match=r"json: expected a file that can be written, .* nothing has read this FIFO"):
        write_file(path, "text", "json")
    assert stat.S_ISFIFO(path.stat().st_mode)


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="only root makes devices")
@pytest.mark.parametrize("write", WRITERS)
def test_devices_are_written_and_not_replaced(write: Writer, tmp_path: Path) -> None:
    """A device, or a link to one, is written; a full one is refused with the reason."""
    null, full, link = tmp_path / "null", tmp_path / "full", tmp_path / "link"
    try:
        os.mknod(null, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        os.mknod(full, 0o666 | stat.S_IFCHR, os.makedev(1, 7))
        null.write_text("")
    except PermissionError:
        pytest.skip("devices cannot be made or opened here")
    link.symlink_to("null")
    for path in (null, link):
        check_writable(path, "json")
        write(path, "text")
    with pytest.raises(ValueError, match=r"path: expected a file .* The system says: No space left on device\."):
        write(full, "text")
    assert stat.S_ISCHR(null.stat().st_mode)
    assert stat.S_ISCHR(full.stat().st_mode)
    assert link.is_symlink()
    assert {file.name for file in tmp_path.iterdir()} == {"null", "full", "link"}


@pytest.mark.skipif(sys.platform != "linux", reason="descriptors have names in /proc")
@pytest.mark.parametrize("redirection", ["all.txt", "file", "pipe"])
@pytest.mark.parametrize("name", ["/proc/self/fd/1", "/dev/fd/1", "link"])
def test_file_descriptors_are_written_at_their_offset(redirection: str, name: str, tmp_path: Path) -> None:
    """What a command writes to its own output by name stands between what it prints before and after."""
    (tmp_path / "link").symlink_to("/proc/self/fd/1")
    code = (
        "import sys; from slam_backend.core.files import check_writable, write_file\n"
        f"print('before', flush=True); check_writable({name!r}, 'json'); write_file({name!r}, 'in\\n'); print('after')"
    )
    shell = {
        "all.txt": f"'{sys.executable}' -c \"$1\" >> all.txt",
        "file": f"echo first > file; '{sys.executable}' -c \"$1\" > file",
        "pipe": f"'{sys.executable}' -c \"$1\" | cat > file",
    }[redirection]
    environment = os.environ | {"PYTHONPATH": str(Path(files.__file__).parents[2])}
    (tmp_path / "all.txt").write_text("first\n")
    subprocess.run(["sh", "-c", shell, "sh", code], cwd=tmp_path, check=True, env=environment)
    found = (tmp_path / ("all.txt" if redirection == "all.txt" else "file")).read_text()
    assert found == ("first\n" if redirection == "all.txt" else "") + "before\nin\nafter\n"


@pytest.mark.skipif(sys.platform != "linux", reason="descriptors have names in /proc")
def test_an_open_file_without_a_name_is_written(tmp_path: Path) -> None:
    """The file of a descriptor that was deleted is written, and no file takes its former name."""
    with (tmp_path / "file").open("w+") as file:
        (tmp_path / "file").unlink()
        write_file(f"/proc/self/fd/{file.fileno()}", "text")
        assert file.read() == ""  # written by the same descriptor
        assert file.tell() == 4
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match=r"The system says: Bad file descriptor\."):
        check_writable("/proc/self/fd/987", "json")


def test_a_file_in_a_folder_that_takes_none_is_written_in_place(tmp_path: Path) -> None:
    """Where no file can be made, what is there is written; what is not there, or is write-protected, is refused."""
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "file").write_text("old and longer")
    (folder / "file").chmod(0o666)
    (folder / "protected").write_text("old")
    (folder / "protected").chmod(0o444)
    folder.chmod(0o555)
    here = tmp_path
    while here.parent != here and os.geteuid() == 0:  # pytest's folders are the user's alone
        here.chmod(here.stat().st_mode | 0o055)
        here = here.parent
    refusal = r"expected a file that can be written, .* The system says: Permission denied\."

    def try_all() -> None:
        inode = (folder / "file").stat().st_ino
        check_writable(folder / "file", "json")
        write_file(folder / "file", "new")
        assert ((folder / "file").read_text(), (folder / "file").stat().st_ino) == ("new", inode)
        for name in ("protected", "none"):
            with pytest.raises(ValueError, match="json: " + refusal):
                check_writable(folder / name, "json")
            with pytest.raises(ValueError, match="path: " + refusal):
                write_file(folder / name, "new")
        assert (folder / "protected").read_text() == "old"

    _as_unprivileged_user(try_all)
    folder.chmod(0o755)


def test_a_file_of_another_user_keeps_its_owner(tmp_path: Path) -> None:
    """A file that may be written, and whose owner a rename would change, is written in place."""
    if os.geteuid() != 0:
        pytest.skip("only root makes files of others")
    folder = tmp_path / "folder"
    folder.mkdir()
    folder.chmod(0o777)
    (folder / "file").write_text("old")
    (folder / "file").chmod(0o666)
    here = tmp_path
    while here.parent != here:
        here.chmod(here.stat().st_mode | 0o055)
        here = here.parent
    _as_unprivileged_user(lambda: write_file(folder / "file", "new"))
    assert ((folder / "file").read_text(), (folder / "file").stat().st_uid) == ("new", 0)
    assert [file.name for file in folder.iterdir()] == ["file"]


def _as_unprivileged_user(work: Callable[[], object]) -> None:
    """Call a function as a user without rights, if the tests run as root."""
    if os.geteuid() != 0:
        work()
        return
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.setgid(65534)
            os.setuid(65534)
            work()
            status = 0
        finally:
            os._exit(status)
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.parametrize("write", WRITERS)
def test_a_file_that_is_mounted_is_written_in_place(
    write: Writer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A single file that a container mounts is busy for a rename, and written."""
    path = tmp_path / "file"
    path.write_text("old and longer")

    def busy(part: Path, target: Path) -> None:
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), str(part))

    monkeypatch.setattr(Path, "replace", busy)
    write(path, "new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    """The reason is said, nothing is left beside the old content, and appended text is there whole or not at all."""
    path = tmp_path / "file"
    append_text(path, "row 1\n")
    message = r"out: expected a file that can be written, .* says: File too large\."
    for write in (write_file, append_text):
        with files_up_to(5000), pytest.raises(ValueError, match=message):
            write(path, "x" * 10_000, "out")
    assert path.read_text() == "row 1\n"
    append_text(path, "row 2\n")
    assert path.read_text() == "row 1\nrow 2\n"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (None, r"path: expected the path of a file, got None\."),
        ("a\0b", r"path: expected the path of a file, got 'a.x00b'\."),
        ("", r"path: expected a file that can be written, .* says: Is a directory\."),
        (".", r"path: expected a file that can be written, .* says: Is a directory\."),
        ("loop", r"path: expected a file that can be written, .* says: Too many levels of symbolic links\."),
        ("x" * 300, r"path: expected a file that can be written, .* says: File name too long\."),
        ("file/below", r"path: expected a file that can be written, .* says: Not a directory\."),
        ("none/file", r"path: expected a file that can be written, .* says: No such file or directory\."),
    ],
)
def test_a_path_that_is_not_a_file_is_refused(
    path: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line says what cannot be written and why; nothing is changed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "file").write_text("old")
    with pytest.raises(ValueError, match=message):
        write_file(path, "text")
    if path:
        with pytest.raises(ValueError, match=r"path: expected (a file|the path)"):
            check_writable(path, "path")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "loop"]
