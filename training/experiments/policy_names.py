"""Names of policies on the command line and in files: `LABEL=POLICY`, and custom policies, `MODULE:NAME`.

Modules of custom policies are imported only if the command line, not only a file, names them.
"""

import re
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

LABELLED = re.compile(r"([\w.+-]+)=(.+)", re.DOTALL)
OPTIONS = ("policy", "policies")  # options, and values of configurations, that name policies


def parted_label(text: str) -> tuple[str, str]:
    """Return label and policy of `LABEL=POLICY`; the label is empty where none is given.

    >>> parted_label("mine=look_again:LookAgain@discrete"), parted_label("runs/a=b/model.npz")
    (('mine', 'look_again:LookAgain@discrete'), ('', 'runs/a=b/model.npz'))
    """
    match = None if Path(text).exists() else LABELLED.fullmatch(text)
    return (match[1], match[2]) if match else ("", text)


def check_labels(texts: Iterable[str]) -> None:
    """Refuse two policies with the same label, which results could not tell apart.

    Raises:
        ValueError: If a label occurs twice.
    """
    from slam_backend.core.validation import argument_error

    labels: dict[str, str] = {}
    for text in texts:
        label, policy = parted_label(text)
        if labels.setdefault(label or text, policy) != policy:
            hint = f"Both {labels[label or text]!r} and {policy!r} have it."
            raise argument_error("policies", "a different label for each policy", label or text, hint)


def check_named(values: Iterable[Any], given: Any, option: str = "policies") -> None:
    """Refuse custom policies, `MODULE:NAME`, that a file names and the user does not.

    Args:
        values: Values of the file; only texts are looked at.
        given: Policy, or policies, that the user gave; None: none.
        option: Option with which the user names them.

    Raises:
        ValueError: If there is one; the message has the complete command.
    """
    from agents.plugins import is_plugin
    from slam_backend.core.validation import argument_error

    texts = [values] if isinstance(values, str) else values
    wanted = list(dict.fromkeys(value for value in texts if isinstance(value, str)))
    allowed = {_module_and_name(value) for value in ([given] if isinstance(given, str) else given or ())}
    for value in wanted:
        name = _module_and_name(value)
        if is_plugin(name) and name not in allowed:
            command = shlex.join(["vslam", *sys.argv[1:], f"--{option}", ",".join(wanted)])
            hint = f"If you trust this module, which the file names, run it with: {command}"
            raise argument_error(option, "custom policies that the command line names, too", name, hint)


def check_configuration(values: dict[str, Any], given: dict[str, Any]) -> None:
    """Refuse the custom policies of a configuration that the given options do not name, see `check_named`."""
    for option in OPTIONS:
        if option in values and option not in given:
            check_named(values[option] if isinstance(values[option], (str, list)) else (), None, option)


def _module_and_name(policy: str) -> str:
    """Return a policy without label and action type.

    >>> _module_and_name("mine=look_again:LookAgain@discrete")
    'look_again:LookAgain'
    """
    return parted_label(policy)[1].partition("@")[0]
