"""Command `vslam evaluate`: comparison of a trained model with baseline policies on unseen worlds."""

from training.commands.helpers.options import Workers, options
from training.commands.helpers.run_folder import Call
from training.commands.study import run_study
from training.rl.config import EvaluateConfig


@options(EvaluateConfig, "evaluate", continues=True)
def evaluate(call: Call[EvaluateConfig], workers: Workers = 1) -> None:
    """Compare a model with baseline policies on the same unseen worlds, with confidence intervals.

    All policies have the same worlds, starts and noise, and the same decision interval.
    Ctrl-C finishes the current episode; the same command with --out FOLDER
    resumes the evaluation.
    """
    from training.rl.evaluation import STUDY

    run_study(call, STUDY, workers)
