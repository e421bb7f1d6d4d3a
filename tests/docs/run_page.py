"""Run the programs of a page as written, with its learner installed: `python run_page.py PAGE`."""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)

if __name__ == "__main__":
    programs = BLOCK.findall(Path(sys.argv[1]).read_text(encoding="utf-8"))
    if not programs:
        sys.exit(f"{sys.argv[1]}: expected programs, got none.")
    for program in programs:
        with tempfile.TemporaryDirectory() as folder:  # removes the output of a program
            (Path(folder) / "page.py").write_text(program, encoding="utf-8")
            subprocess.run([sys.executable, "page.py"], cwd=folder, check=True)
    print(f"{sys.argv[1]}: its programs ran to their ends.")
