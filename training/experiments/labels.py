"""Labels of policies on the command line: `LABEL=POLICY`, for tables and figures."""

import re
from collections.abc import Iterable
from pathlib import Path

LABELLED = re.compile(r"([\w.+-]+)=(.+)", re.DOTALL)


def parted_label(text: str) -> tuple[str, str]:
    """Return label and policy of `LABEL=POLICY`; the label is empty where none is given.

    >>> parted_label("mine=look_again:LookAgain@discrete"), parted_label("runs/a=b/model.npz")
    (('mine', 'look_again:LookAgain@discrete'), ('', 'runs/a=b/model.npz'))
    """
    found = None if Path(text).exists() else LABELLED.fullmatch(text)
    return (found[1], found[2]) if found else ("", text)


def check_labels(texts: Iterable[str]) -> None:
    """Refuse two policies with the same label, which results could not tell apart.

    Raises:
        ValueError: If a label occurs twice.
    """
    from slam_backend.core.validation import argument_error

    labels: dict[str, str] = {}
    for text in texts:
        label, policy = parted_label(text)
        if label and labels.setdefault(label, policy) != policy:
            hint = f"Both {labels[label]!r} and {policy!r} have it."
            raise argument_error("policies", "a different label for each policy", label, hint)
