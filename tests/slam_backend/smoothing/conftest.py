"""Helpers of the tests beside this folder are importable here as well."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))
