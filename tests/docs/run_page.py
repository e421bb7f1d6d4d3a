"""Run the programs of a page as written, with their learner installed: `python run_page.py PAGE [SECTION]`."""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)


def programs(page: Path, section: str | None = None) -> list[str]:
    """Return the programs of a page, or those under its heading `## SECTION`, whose case does not matter."""
    text = page.read_text(encoding="utf-8")
    if section is not None:
        parts = re.split(r"^## (.+)\n", text, flags=re.MULTILINE)
        text = dict(zip(map(str.lower, parts[1::2]), parts[2::2], strict=True)).get(section.lower(), "")
    return BLOCK.findall(text)


if __name__ == "__main__":
    name = " ".join(sys.argv[1:])
    found = programs(Path(sys.argv[1]), *sys.argv[2:3])
    if not found:
        sys.exit(f"{name}: expected programs, got none.")
    for program in found:
        with tempfile.TemporaryDirectory() as folder:  # removes the output of a program
            (Path(folder) / "page.py").write_text(program, encoding="utf-8")
            subprocess.run([sys.executable, "page.py"], cwd=folder, check=True)
    print(f"{name}: its programs ran to their ends.")
