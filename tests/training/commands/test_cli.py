import os
import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoint, version
from pathlib import Path
from typing import Any, NoReturn

import pytest
from typer.main import get_command

import vslam_env
from training import cli
from vslam_env import __main__ as entry


def test_a_fault_of_the_program_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ValueError without the project's format is not bad input."""

    def broken(prog_name: str) -> None:
        raise ValueError("operands could not be broadcast together")

    monkeypatch.setattr(cli, "app", broken)
    with pytest.raises(ValueError, match="broadcast"):
        cli.main()


def test_an_interrupt_while_the_program_is_loaded_is_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """The status is that of an interrupted command."""

    def interrupted(name: str) -> NoReturn:
        raise KeyboardInterrupt

    monkeypatch.setattr(entry, "import_module", interrupted)
    with pytest.raises(SystemExit) as ended:
        entry.main()
    assert ended.value.code == cli.INTERRUPTED


def test_the_list_of_commands_says_what_each_says_of_itself() -> None:
    """The first sentence of each command's own help stands in the list, for which no command is imported."""
    group: Any = get_command(cli.app)
    for name, command in group.commands.items():
        assert " ".join(command.help.split("\n\n")[0].split()) == cli.COMMANDS[name][-1]
    program = "import sys\nfrom training import cli\nsys.argv = ['vslam', '--help']\n"
    program += (
        "try: cli.main()\nexcept SystemExit: print([n for n in sys.modules if n.startswith('training.commands.')])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("module", ["training", "training.cli", "vslam_env"])
def test_modules_run_the_command(module: str) -> None:
    """`python -m` of the packages and of the command line has the output and exit status of `vslam`."""
    for arguments, status, says in (
        (["--help"], 0, "Usage: vslam"),
        (["--version"], 0, f"vslam-env {version('vslam-env')}"),
        (["run", "--robots", "0"], 2, "robots: expected"),
    ):
        done = subprocess.run([sys.executable, "-m", module, *arguments], capture_output=True, text=True)
        assert done.returncode == status
        assert says in done.stdout + done.stderr


@pytest.mark.parametrize("name", ["agents", "training"])
@pytest.mark.parametrize("form", ["{}.py", "{}/__init__.py"])
def test_a_module_that_hides_a_package_is_named_and_not_run(name: str, form: str, tmp_path: Path) -> None:
    """A user's own `training.py` in the current folder, or a package on the path, gives one line with its path."""
    file = tmp_path / "a folder" / form.format(name)
    file.parent.mkdir(parents=True)
    file.write_text("raise SystemExit('it was run')\n", encoding="utf-8")
    root = str(Path(cli.__file__).parents[1])
    shown = file.parent if file.name == "__init__.py" else file
    for place, path in ((tmp_path / "a folder", root), (tmp_path, f"{tmp_path / 'a folder'}{os.pathsep}{root}")):
        command = [sys.executable, "-m", "vslam_env", "worlds", "list"]
        done = subprocess.run(command, cwd=place, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (2, "")
        (line,) = done.stderr.splitlines()
        assert line.startswith(f"error {name}: expected this project's package")
        assert repr(str(shown)) in line
        assert "Rename" in line


def test_the_command_starts_where_names_are_checked() -> None:
    """The declared command is the entry point that looks for hidden packages."""
    declared = tomllib.loads((Path(cli.__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    assert EntryPoint("vslam", declared["project"]["scripts"]["vslam"], "console_scripts").load() is entry.main


def test_help_needs_no_heavy_import() -> None:
    """The command line is built without numba, OpenCV, matplotlib or torch, so that --help is fast."""
    heavy = "{'numba', 'cv2', 'matplotlib', 'torch', 'scipy'}"
    code = f"import sys, training.cli; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("arguments", [("run", "--max-cycles", "3"), ("worlds", "preview", "fig5")])
def test_a_deleted_folder_gives_a_one_line_error(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """A command called in a deleted folder has a clear error; --help works there."""
    gone = tmp_path / "gone"
    gone.mkdir()
    shell = ["sh", "-c", 'rmdir "$0"; exec "$@"', str(gone), sys.executable, "-m", "training"]
    environment = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[1])}
    done = subprocess.run([*shell, *arguments], cwd=gone, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    expected = "error folder: expected a current folder, got a deleted one. Change into one that exists."
    assert done.stderr.splitlines() == [expected]
    gone.mkdir()
    assert subprocess.run([*shell, "--help"], cwd=gone, env=environment, capture_output=True).returncode == 0


def test_the_version_is_that_of_the_distribution() -> None:
    """`vslam_env.__version__` is what `vslam --version` prints."""
    assert vslam_env.__version__ == version("vslam-env")


def test_figures_of_the_paper_are_listed_in_order() -> None:
    """`vslam paper --help` lists fig1 to fig6."""
    assert list(get_command(cli.app).commands["paper"].commands) == [f"fig{n}" for n in range(1, 7)]  # type: ignore[attr-defined]


def test_words_mean_the_same_in_all_commands() -> None:
    """No command has a second word for what others call --workers, --world-split, --proposal or --max-seconds."""
    former = {"--processes", "--jobs", "--split", "--estimator", "--decisions", "--lookalikes"}
    assert not former & {option for params in _options().values() for option in params}
    lists = {"--world": "--worlds", "--policy": "--policies", "--preset": "--presets", "--length": "--lengths"}
    for command, params in _options().items():
        for one, many in lists.items():
            assert not {one, many} <= params, f"{command} has {one} and {many}"


def _options() -> dict[str, set[str]]:
    """Return the options of all commands."""
    found: dict[str, set[str]] = {}

    def walk(command: Any, name: str) -> None:
        for word, below in getattr(command, "commands", {}).items():
            walk(below, f"{name} {word}")
        found[name] = {option for param in command.params for option in param.opts}

    walk(get_command(cli.app), "vslam")
    return found


def test_shells_complete_commands_options_and_names() -> None:
    """Completion offers commands, options, and the names that an option takes, also after a comma."""
    for words, wanted in (
        ("vslam be", {"bench"}),
        ("vslam run --max-s", {"--max-seconds"}),
        ("vslam run --preset s", {"standard"}),
        ("vslam bench exploration --oracles none,a", {"none,association", "none,all"}),
    ):
        environment = os.environ | {
            "_VSLAM_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1),
        }  # fmt: skip
        done = subprocess.run(
            [sys.executable, "-m", "training"], env=environment, capture_output=True, text=True, check=False
        )
        assert wanted <= set(done.stdout.split()), (words, done.stdout, done.stderr)


def test_the_log_level_shows_what_a_run_does(vslam: Any, tmp_path: Path) -> None:
    """With `--log-level debug` a run reports its folder on stderr; by default it does not."""
    few = ("run", "--world", "fig5", "--robots", "1", "--max-cycles", "3", "--particles", "5", "--no-video")
    for level, name in (("info", "loud"), ("warning", "calm")):
        said = vslam("--log-level", level, *few, "--out", str(tmp_path / name))
        assert said.status == 0
        assert ("configuration in" in said.err) is (level == "info")
    assert "log-level" in vslam("--log-level", "loud", *few).err
