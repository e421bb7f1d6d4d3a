"""Card of a data set: what it is, its arrays, its numbers, how to load it, and how to make it again."""

from collections.abc import Mapping, Sequence
from typing import Any

from training.dataset.recording import Field
from training.experiments.output.tables import escaped, markdown_table, significant
from training.experiments.run_folder import CONFIG_FILE, RunFolder

CARD = "README.md"
SUMS = "SHA256SUMS"
LOAD = """import numpy as np

with np.load("episode_00000.npz") as episode:
    seen, actions, rewards = episode["observations/pose"], episode["actions"], episode["rewards"]
    print(seen.shape, actions.shape, rewards.sum(axis=1), episode["truth/poses"][:, -1])
"""


def card(folder: RunFolder, rows: Sequence[Mapping[str, Any]], fields: Mapping[str, Field], digest: str) -> str:
    """Return the text of a data set's card.

    Args:
        folder: Folder of the data set.
        rows: Rows of the episodes, see `training.dataset.recording.play`.
        fields: Arrays of a file by name.
        digest: Digest of all files.
    """
    config, robots = folder.config, fields["rewards"].shape[0]
    world, policy = (escaped(str(config[name])) for name in ("world", "policy"))
    about = (
        f"{len(rows)} of {config['episodes']} episodes of {robots} robot{'' if robots == 1 else 's'}: world {world}, "
        f"noise {config['preset']}, policy {policy}, {config['action_type']} actions; recorded by vslam-env "
        f"{folder.versions.get('vslam-env', '')}. An episode is a file, and a function of `{CONFIG_FILE}` and its seed."
    )
    arrays = [
        (f"`{name}`", ", ".join(map(str, field.shape)), field.dtype, _bounds(field), field.unit, field.meaning)
        for name, field in fields.items()
    ]
    return "\n".join([
        "# Episodes of multi-robot SLAM and exploration", "", about, "",
        markdown_table(("over all episodes", "sum", "mean", "least", "most"), _statistics(rows)),
        "## Load", "", f"```python\n{LOAD}```", "",
        "`training.dataset.reading.load_episodes(folder)` of vslam-env checks digests and shapes, "
        "`to_minari(folder, name)` makes a data set of Minari.", "",
        "## Arrays of a file", "",
        markdown_table(("array", "shape", "dtype", "range", "unit", "meaning"), arrays),
        "`times` is one more than `steps`. Row t of an observation was seen at `times[t]`; action, reward, termination "
        "and truncation t belong to the step from there to `times[t + 1]`. Keys of observations: "
        "`docs/reference/observations.md` of vslam-env.", "",
        "## Digest and recipe", "",
        f"`sha256sum --check {SUMS}` checks the files; the digest of that file is `{digest}`.", "",
        "```sh",
        f"vslam record --verify {folder.path.name}                    # play all episodes again, and compare digests",
        f"vslam record --config {folder.path.name} --out again        # make all files again",
        "```", "",
        f"Versions: {', '.join(f'{name} {version}' for name, version in folder.versions.items())}.", "",
    ])  # fmt: skip


def _bounds(field: Field) -> str:
    """Return the range of an array's numbers in words."""
    if field.low is None:
        return "-"
    if isinstance(field.low, list) or isinstance(field.high, list):
        return "by column"
    return f"{field.low:g} to {field.high:g}"


def _statistics(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return rows of a table of the episodes' numbers."""
    found = []
    for name, words in (
        ("steps", "steps"), ("return", "return of a robot [m]"), ("map_error", "map error at the end [m]"),
        ("coverage", "share of the floor seen"), ("maps", "separate maps at the end"), ("bytes", "bytes on disk"),
    ):  # fmt: skip
        values = [float(row[name]) for row in rows]
        if values:
            total = f"{sum(values):.0f}" if name in ("steps", "bytes") else "-"
            found.append([words, total, *map(significant, (sum(values) / len(values), min(values), max(values)))])
    return found
