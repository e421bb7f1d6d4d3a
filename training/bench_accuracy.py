"""The accuracy bench: trials over conditions, methods, particles and seeds, each kept as soon as it is finished."""

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Self

from slam_backend.errors import bad_argument, check_int
from training.accuracy_trials import FILTERS, METHODS, Trial, play
from training.run_folder import CONFIG_FILE, RunFolder, plain, read_config

COMMAND = "bench accuracy"
TRIALS_FILE = "trials.jsonl"
SINGLE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True, kw_only=True)
class AccuracyConfig:
    """All that decides a bench: each combination of the lists is tried on each seed.

    Attributes:
        presets: Of the noise, keys of `stereo_runs.PRESETS`.
        associations: "known", "unknown" or both.
        robots: Numbers of robots.
        lengths: Of each robot's path [m].
        methods: Of `accuracy_trials.METHODS`.
        particles: Numbers of particles of the filters.
        seeds: How many.
        seed: The first of them.
    """

    presets: tuple[str, ...] = ("good",)
    associations: tuple[str, ...] = ("known",)
    robots: tuple[int, ...] = (1,)
    lengths: tuple[float, ...] = (100.0,)
    methods: tuple[str, ...] = METHODS
    particles: tuple[int, ...] = (10, 30, 100, 300, 1000)
    seeds: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        check_int("seeds", self.seeds, 1, "Run at least one seed.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        for name in ("presets", "associations", "robots", "lengths", "methods", "particles"):
            values = tuple(getattr(self, name))
            if not values or len(set(values)) < len(values):
                raise bad_argument(name, "at least one value, each once", list(values), "Correct the list.")
            object.__setattr__(self, name, values)
        self.trials()  # refuses what no trial can be

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Build a config from plain values, as `to_mapping` gives them; unknown names are refused."""
        known = list(cls.__dataclass_fields__)
        for name in values:
            if name not in known:
                raise bad_argument("config", "one of " + ", ".join(known), name, "Correct the name in the file.")
        return cls(**values)

    def to_mapping(self) -> dict[str, Any]:
        """Return the plain values that repeat this bench, the first seed apart."""
        return {name: value for name, value in asdict(self).items() if name != "seed"}

    def trials(self) -> list[Trial]:
        """Return all trials, those on the same run in a row."""
        return [
            Trial(
                preset=preset, association=association, robots=robots, length=float(length), method=method,  # type: ignore[arg-type]
                particles=particles, seed=seed,
            )
            for seed in range(self.seed, self.seed + self.seeds)
            for preset in self.presets
            for association in self.associations
            for robots in self.robots
            for length in self.lengths
            for method in self.methods
            for particles in (self.particles if method in FILTERS else (0,))
        ]  # fmt: skip


def open_folder(out: Path | None, config: AccuracyConfig) -> RunFolder:
    """Make the run folder, or go on with the one in which the same bench was begun.

    Raises:
        ValueError: If `out` holds another bench, or cannot be written.
    """
    if out is None or not (out / CONFIG_FILE).is_file():
        return RunFolder.create(out, COMMAND, config.to_mapping(), config.seed)
    values, seed = read_config(out, COMMAND)
    if (values, seed) != (plain(config.to_mapping()), config.seed):
        cure = f"Repeat the options in {str(out / CONFIG_FILE)!r}, or choose another folder."
        raise bad_argument("out", "a folder of this very bench", "a folder of one with other options", cure)
    return RunFolder(out, COMMAND, values, seed, {})


def finished_trials(folder: RunFolder) -> dict[Trial, dict[str, Any]]:
    """Read the trials that a folder holds; a last line that was cut off is dropped, from the file too."""
    file = folder.path / TRIALS_FILE
    if not file.is_file():
        return {}
    rows = []
    for line in file.read_text(encoding="utf-8").splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
    folder.write_text(TRIALS_FILE, "".join(json.dumps(row) + "\n" for row in rows))
    return {Trial(**{name: row[name] for name in Trial.__dataclass_fields__}): row for row in rows}


def run_trials(
    folder: RunFolder,
    trials: Iterable[Trial],
    processes: int,
    interrupted: Callable[[], bool],
    on_trial: Callable[[dict[str, Any]], None],
) -> None:
    """Run trials and append each to the folder as it ends; on an interrupt those under way are finished.

    Args:
        folder: Where to keep them.
        trials: Which.
        processes: How many run at a time; 1: in this process.
        interrupted: Asked before each trial.
        on_trial: Called with each row.
    """
    with (folder.path / TRIALS_FILE).open("a", encoding="utf-8") as file:
        rows = map(play, _until(interrupted, trials)) if processes == 1 else _spread(trials, processes, interrupted)
        for row in rows:
            kept = plain(row)
            file.write(json.dumps(kept, allow_nan=False) + "\n")
            file.flush()
            on_trial(kept)


def _until(interrupted: Callable[[], bool], trials: Iterable[Trial]) -> Iterator[Trial]:
    """Hand out trials until Ctrl-C."""
    for trial in trials:
        if interrupted():
            return
        yield trial


def _spread(trials: Iterable[Trial], processes: int, interrupted: Callable[[], bool]) -> Iterator[dict[str, Any]]:
    """Run trials in several processes, each with one thread, and give their rows as they end."""
    context = get_context("spawn")
    before = {name: os.environ.get(name) for name in SINGLE_THREAD}
    os.environ |= dict.fromkeys(SINGLE_THREAD, "1")  # more threads would only get in the other processes' way
    try:
        with ProcessPoolExecutor(processes, mp_context=context, initializer=_leave_interrupts_to_parent) as pool:
            running: set[Future[dict[str, Any]]] = set()
            for trial in _until(interrupted, trials):
                running.add(pool.submit(play, trial))
                while len(running) >= processes:
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in done)
            for future in running:
                yield future.result()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _leave_interrupts_to_parent() -> None:
    """Let Ctrl-C, which reaches all processes of a terminal, end no trial half-way."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
