"""The notebooks: kept with their pictures, public names only, and every cell runs in a clean kernel."""

import ast
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell

from tests.project.test_docs import check_names

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LARGEST = 600_000  # bytes
MACHINE = re.compile(r"/(home|root|tmp|work|Users|usr|var)/|\.venv|site-packages")
WARNINGS_ARE_ERRORS = new_code_cell("import warnings\nwarnings.simplefilter('error')")
every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@every_notebook
def test_the_code_uses_public_names_that_exist(path):
    source = "\n".join(cell.source for cell in code_cells(read(path)))
    plain = "\n".join(line for line in source.splitlines() if not line.startswith("%"))  # magic
    kinds = ast.Attribute | ast.alias | ast.ImportFrom
    nodes = [node for node in ast.walk(ast.parse(plain)) if isinstance(node, kinds)]
    names = [getattr(node, field, None) for node in nodes for field in ("attr", "name", "module")]
    assert not [name for name in names if name and re.search(r"(^|\.)_", name)]
    check_names(plain)


@every_notebook
def test_words_are_words(path):
    """One title; text that an editor of scripts has kept as comments would be a title in every line."""
    lines = [line for cell in read(path).cells if cell.cell_type == "markdown" for line in cell.source.splitlines()]
    assert [line for line in lines if line.startswith("# ") or line == "#"] == lines[:1]


@every_notebook
def test_kept_as_run_with_pictures_and_nothing_of_the_machine(path):
    notebook = read(path)
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 3
    assert path.stat().st_size < LARGEST
    assert notebook.metadata.kernelspec.name == "python3"
    assert not any(cell.metadata for cell in notebook.cells)
    text = [output.get("text", "") + output.get("data", {}).get("text/plain", "") for output in outputs]
    assert not MACHINE.search("\n".join([*text, *(cell.source for cell in notebook.cells)]))


@pytest.mark.slow
@pytest.mark.nightly
@every_notebook
def test_runs_in_a_clean_kernel(path):
    """All cells in a kernel of their own, in the root of the checkout, where a warning is an error."""
    notebook = read(path)
    notebook.cells.insert(0, nbformat.from_dict(WARNINGS_ARE_ERRORS))
    NotebookClient(notebook, kernel_name="python3", timeout=600, resources={"metadata": {"path": str(ROOT)}}).execute()
