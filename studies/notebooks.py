"""Make the notebooks: run the sources in `docs/notebooks` in Jupyter, and keep them with their output.

python -m studies.notebooks                    # all, as `make notebooks` does
python -m studies.notebooks first_episode ...
"""

import re
import sys
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from PIL import Image

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "notebooks"
COLOURS = 64  # of a picture
TIMEOUT = 1800  # for one cell, which may compile kernels [s]
WHEEL = re.compile(r"VSLAM_WHEEL=[^ \n]+")  # in the README; `make install-from` sets it there and here
INSTALL = """\
# On Colab this cell installs the package and its compiled kernels; elsewhere it does nothing
import sys

if "google.colab" in sys.modules:
    %env {wheel}
    %pip install --quiet --find-links "$VSLAM_WHEEL" vslam-env vslam-env-kernels"""


def install_cell() -> str:
    """Return the first cell of each notebook, which installs from where the README does."""
    wheel = WHEEL.search((ROOT / "README.md").read_text(encoding="utf-8"))
    assert wheel is not None
    return INSTALL.format(wheel=wheel[0])


def executed(notebook: Any) -> Any:
    """Return a notebook after its cells ran in Jupyter in an empty folder; what they say on stderr is printed here.

    Raises:
        nbclient.exceptions.CellExecutionError: If a cell fails.
    """
    from nbclient import NotebookClient

    with TemporaryDirectory() as folder:
        place = {"metadata": {"path": folder}}
        client = NotebookClient(notebook, timeout=TIMEOUT, kernel_name="python3", record_timing=False, resources=place)
        client.execute()
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            if output.get("name") == "stderr":
                print(output.text, file=sys.stderr)
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    return notebook


def made(source: Path) -> Any:
    """Return the notebook of a source with its output: the same content at each call, and small."""
    import jupytext
    from nbformat import v4

    notebook = executed(jupytext.read(source))
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            if "image/png" in output.get("data", {}):
                output.data["image/png"] = compressed(output.data["image/png"])
    notebook.cells.insert(0, v4.new_code_cell(install_cell(), metadata={"tags": ["install"]}))
    for index, cell in enumerate(notebook.cells):
        cell.id = f"cell-{index}"
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook.metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return notebook


def compressed(picture: str) -> str:
    """Return a PNG in base64 with few colours."""
    from base64 import b64decode, b64encode

    packed = BytesIO()
    image = Image.open(BytesIO(b64decode(picture))).convert("RGB")
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(packed, "PNG", optimize=True)
    return b64encode(packed.getvalue()).decode()


def main(names: list[str]) -> None:
    """Make the notebooks with these names, or all."""
    import nbformat

    for source in sorted(FOLDER.glob("*.py")):
        if not names or source.stem in names:
            nbformat.write(made(source), source.with_suffix(".ipynb"))
            print(source.with_suffix(".ipynb").relative_to(ROOT))


if __name__ == "__main__":
    main(sys.argv[1:])
