"""Command `vslam record`: episodes as a data set."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from training.commands.helpers.options import Workers, options
from training.commands.helpers.progress import TrialSet, run_trial_set, trial_progress
from training.commands.helpers.run_folder import Call
from training.dataset.config import RecordConfig

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from training.dataset.recording import Field
    from training.experiments.run_folder import RunFolder

ENVIRONMENT = "environment.toml"


@options(RecordConfig, "record", continues=True)
def record(
    call: Call[RecordConfig], workers: Workers = 1,
    verify: Annotated[
        Path | None,
        typer.Option(help="Play the episodes of this folder again, and compare their digests.", show_default=False),
    ] = None,
) -> None:  # fmt: skip
    """Record episodes as a data set: observations, actions, rewards, ends and the truth, with a card and digests.

    An episode is a file of numpy, and a function of the configuration and its seed: any number of workers writes
    the same bytes. Ctrl-C finishes the current episodes; the same command with --out FOLDER resumes. With --verify,
    the exit status is 1 if an episode differs.
    """
    if verify is not None:
        verify_dataset(call, verify, workers)
        return
    from training.bench.exploration.trials import check_same_policies
    from training.dataset.recording import EpisodeTrial, check_room, fields_of, play

    config = call.config
    check_same_policies(call.out, {config.policy})
    env = config.make_env()
    size = check_room(config, env, call.out)
    console, folder = call.begin(partial(_first_steps, config, env))
    console.print(size)
    folder.write_text(ENVIRONMENT, env.config.replace(world=folder.config["world"]).to_toml())
    trials = config.trials()
    part = TrialSet(kind=EpisodeTrial, play=partial(play, config, folder.path), trials=trials, workers=workers)
    rows = run_trial_set(console, folder, part)
    _describe(call, folder, rows, fields_of(env))
    call.finish()
    if part.failures:
        raise typer.Exit(2)


def _first_steps(config: RecordConfig, env: Any) -> None:
    """Run the first two steps of the first episode, which detect bad input; the episode itself reports its policy."""
    from training.episodes.runner import run_episode

    steps = iter(range(2))
    run_episode(
        env, config.make_policies(env), config.seed, should_stop=lambda: next(steps, None) is None,
        options=config.reset_options(),
    )  # fmt: skip


def _describe(
    call: Call[RecordConfig], folder: "RunFolder", rows: list[dict[str, Any]], fields: "dict[str, Field]"
) -> None:
    """Write description, card and digests of the episodes so far, after a check that their files are there."""
    import hashlib

    from training.dataset.card import CARD, SUMS, card
    from training.dataset.reading import FORMAT, check_file
    from training.dataset.recording import sums

    for row in rows:
        check_file(folder.path / row["file"], row["sha256"])
    digest = hashlib.sha256(sums(rows).encode()).hexdigest()
    call.write({
        "format": FORMAT, "sha256": digest, "episodes": rows,
        "arrays": {name: field._asdict() for name, field in fields.items()},
    })  # fmt: skip
    folder.write_text(SUMS, sums(rows))
    folder.write_text(CARD, card(folder, rows, fields, digest))
    call.console.print(
        f"{len(rows)} episodes, {sum(row['steps'] for row in rows)} steps, "
        f"{sum(row['bytes'] for row in rows) / 2**20:.1f} MiB, digest {digest[:12]}: {folder.path / CARD}",
        soft_wrap=True,
    )


def verify_dataset(call: Call[RecordConfig], folder: Path, workers: int) -> None:
    """Check the files of a data set, play its episodes again, and compare the digests.

    Raises:
        ValueError: If options that it fixes are given, the folder is no data set, or a file has changed.
        typer.Exit: With status 1 if an episode differs, 2 if the policy fails.
    """
    from contextlib import closing
    from itertools import takewhile

    from slam_backend.core.validation import argument_error
    from training.dataset.reading import check_file, read_description
    from training.dataset.recording import play
    from training.experiments.output.compilation import prepare
    from training.experiments.output.console import print_error
    from training.experiments.policy_names import check_configuration
    from training.experiments.run_folder import installed_versions, read_config, read_versions
    from training.experiments.trial_store import FAILED, run_in_processes

    others = {"out": call.out, "json": call.json, "config": call.file}
    given = [name for name in call.given if name != "policy"] + [name for name in others if others[name] is not None]
    if given:
        raise argument_error("verify", "no options that the data set fixes", given, "Omit all but --workers.")
    values, seed = read_config(folder, "record", "verify")
    check_configuration(values, call.given)
    config = RecordConfig.from_mapping(values | {"seed": seed})
    stored = {row["episode"]: row for row in read_description(folder, "verify").rows}
    for row in stored.values():
        check_file(folder / row["file"], row["sha256"])
    env = config.make_env()
    prepare(partial(_first_steps, config, env))
    different: list[int] = []
    with trial_progress(call.console, len(stored), timed=False) as (advance, interrupted):
        going = takewhile(lambda _: not interrupted(), (t for t in config.trials() if t.episode in stored))
        done = 0
        with closing(run_in_processes(partial(play, config, None), going, workers)) as rows:
            for again in rows:
                if FAILED in again:
                    print_error(again[FAILED], call.console)
                    raise typer.Exit(2)
                if again["sha256"] != stored[again["episode"]]["sha256"]:
                    different.append(again["episode"])
                done += 1
                advance(f"episode {again['episode']}")
    call.console.print(f"{done} of {len(stored)} episodes played again, {done - len(different)} with the same bytes.")
    before, now = read_versions(folder), installed_versions()
    changed = [f"{name} {version}, here {now.get(name, 'none')}" for name, version in before.items()
               if now.get(name) != version]  # fmt: skip
    if changed:
        call.console.print(f"Recorded with other versions: {'; '.join(changed)}.", soft_wrap=True)
    if different:
        text = f"Different episodes: {', '.join(map(str, sorted(different)))} (docs/how-to/reproducibility.md)."
        call.console.print(text, soft_wrap=True)
        raise typer.Exit(1)
