"""Submissions: the results of a run on a plan and the files of its policies, with their digests, in one folder."""

import gzip
import hashlib
from pathlib import Path

import tomli_w

import agents
from slam_backend.core.files import write_file
from slam_backend.core.validation import argument_error
from training.bench.exploration.episodes import PACKED, episodes_csv
from training.bench.exploration.leaderboard import Results, read_results
from training.bench.exploration.plan import PLAN_COPY
from training.bench.exploration.players import label, parted
from training.bench.exploration.verification import VERIFIED_FILE
from training.experiments.run_folder import CONFIG_FILE, check_free

SUBMISSION = "submission.toml"
OWN = Path(agents.__file__).parent  # policies of this project are named by their digests alone


def submit(folder: Path, out: Path) -> Results:
    """Write the files of a submission into a new folder: rows, comparisons, configuration, policies, and digests.

    Args:
        folder: Run folder of a plan, with the episodes of the base part.
        out: New or empty folder.

    Raises:
        ValueError: If the results have no place in a leaderboard (`read_results`), a policy's file is missing or is
            another one than when its episodes were played, or `out` is not free.
    """
    results = read_results(folder)
    check_free(out)
    contents = {CONFIG_FILE: (folder / CONFIG_FILE).read_bytes()}
    contents[PACKED] = gzip.compress(episodes_csv(results.rows).encode(), 9, mtime=0)
    for name in (VERIFIED_FILE, PLAN_COPY):
        if (folder / name).is_file():
            contents[name] = (folder / name).read_bytes()
    about: dict[str, dict[str, str]] = {}
    for policy, row in {row["policy"]: row for row in results.rows}.items():
        about[policy] = {"version": row["version"], "action_type": row["action_type"], "digest": row["policy_digest"]}
        if row["policy_digest"]:
            file = parted(policy).source_file()
            assert file is not None  # it has a digest
            content = file.read_bytes()
            if hashlib.sha256(content).hexdigest()[:16] != row["policy_digest"]:
                hint = "Restore the file, or play again in a new folder."
                raise argument_error("folder", f"the file of {label(policy)!r} as it was played", str(file), hint)
            about[policy]["file"] = file.name
            if not file.is_relative_to(OWN):
                contents[file.name] = content
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    card = {"plan": results.plan.name, "plan_hash": results.plan.digest, "policies": about, "files": digests}
    out.mkdir(parents=True, exist_ok=True)
    for name, content in {**contents, SUBMISSION: tomli_w.dumps(card).encode()}.items():
        write_file(out / name, content, "out")
    return results
