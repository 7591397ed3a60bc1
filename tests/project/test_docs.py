"""What the documentation and the notebooks show is so: links, paths, commands, code, names, dependencies."""

import ast
import importlib
import inspect
import itertools
import pydoc
import re
import shlex
import sys
import tomllib
from pathlib import Path
from typing import get_args

import nbformat
import pytest
import typer
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell

import mjx_climb as mc
from mjx_climb.control import LAWS
from tests.pages import FENCE, commands, difference, fences
from tuning.command_line.program import program
from tuning.methods import Method, method_of
from tuning.problem import search

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
README = (ROOT / "README.md").read_text("utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PROGRAM = typer.main.get_command(program())
LINK = re.compile(r"\]\(([^)\s]+)\)")
INLINE = re.compile(r"`([^`\n]+(?:\n[^`\n]+)?)`")
MOVED = 0.4  # share, of numbers that a notebook prints
PATH = re.compile(r"(?:\.ci|configs|docs|mjx_climb|notebooks|tests|tuning)/[\w./-]*")


def inline(text: str) -> list[str]:
    return [" ".join(code.split()) for code in INLINE.findall(FENCE.sub("", text))]


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and Python-Markdown make them."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", text), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


def parsed(arguments: list[str]) -> dict:
    """Return the values of a call, which must be complete."""
    name, *rest = arguments
    assert name in PROGRAM.commands, f"no such command: {name}"
    return PROGRAM.commands[name].make_context(name, rest).params


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_shows_is_there(page, monkeypatch):
    """Links, paths, targets of make, names of ours; and code is as narrow as its box, 112 columns at 1400 px."""
    text = page.read_text("utf-8")
    for link in (link for link in LINK.findall(FENCE.sub("", text)) if not re.match(r"[a-z]+:", link)):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text("utf-8")), link
    words = [word for code in inline(text) for word in code.split() if PATH.fullmatch(word)]
    assert [word for word in words if not (ROOT / word).exists()] == []
    made = [target for block in fences(text, "sh") for target in re.findall(r"^make ([\w-]+)", block, re.MULTILINE)]
    made += [code.split()[1] for code in inline(text) if re.match(r"make [\w-]+$", code)]
    assert set(made) <= set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    lines = [line for body in fences(text, "sh", "text", "python", "yaml") for line in body.split("\n")]
    assert [line for line in lines if len(line) > 112] == []
    monkeypatch.syspath_prepend(page.parent)
    for block in fences(text, "python"):
        check_names(block)
    # names of ours in full; the changelog's are of former times
    shown = [code.partition("(")[0] for code in inline(text) if page.name != "CHANGELOG.md"]
    shown += re.findall(r"^::: (.+)$", text, re.MULTILINE)
    names = filter(re.compile(r"(?:mjx_climb|tuning)(?:\.\w+)+").fullmatch, shown)
    assert [name for name in names if pydoc.locate(name) is None] == []


def test_pages_show_something_of_each_kind():
    """So that a pattern that finds nothing any more is noticed."""
    text = "\n".join(page.read_text("utf-8") for page in PAGES)
    kinds = (r"\]\([^)\s:]+#", r"`configs/", r"^make test", r"^```python", r"`mjx_climb\.\w+\.", "^::: mjx_climb", "#")
    assert all(re.search(kind, text, re.MULTILINE) for kind in kinds)


@pytest.mark.parametrize("page", [page for page in PAGES if "mjx-climb " in page.read_text("utf-8")])
def test_commands_are_understood(page):
    """Calls in blocks are complete, with keys that a scenario has; those within a sentence may be cut short."""
    text = page.read_text("utf-8")
    for arguments in (call for block in fences(text, "sh") for call in commands(block)):
        values = parsed(arguments)
        config = values.get("config")
        if config is not None and Path(config).parts[0] == "configs":
            mc.load_scenario(ROOT / config, values.get("changes") or ())
    for name, *rest in (shlex.split(code)[1:] for code in inline(text) if code.startswith("mjx-climb ")):
        if name.isupper():  # stands for any
            continue
        assert name in PROGRAM.commands or name.startswith("--"), name
        known = {option for parameter in PROGRAM.commands.get(name, PROGRAM).params for option in parameter.opts}
        assert {word.partition("=")[0] for word in rest if word.startswith("--")} <= known | {"--help"}, rest


def test_pages_give_a_folder_to_one_run():
    """Who follows one page after the other is not refused: a folder with another run's result is not written to."""
    given: dict[str, set[tuple[str, ...]]] = {}
    for page in PAGES:
        for arguments in (call for block in fences(page.read_text("utf-8"), "sh") for call in commands(block)):
            if "--out" in arguments and arguments[0] not in ("schema", "export"):
                given.setdefault(arguments[arguments.index("--out") + 1], set()).add(tuple(arguments))
    assert len(given) > 5 and [runs for runs in given.values() if len(runs) > 1] == []


@pytest.mark.parametrize("name", PROGRAM.commands)
def test_examples_in_the_help_are_understood(name):
    found = commands(inspect.cleandoc(PROGRAM.commands[name].help).replace("\b", ""))
    assert found
    for arguments in found:
        parsed(arguments)


def check_names(source: str) -> None:
    """Imports resolve (also of a script beside the page), names of modules are there, and calls of ours bind."""
    tree, names = ast.parse(source), {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.asname or alias.name: importlib.import_module(alias.name) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = importlib.import_module(node.module)
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")
                names[alias.asname or alias.name] = getattr(module, alias.name)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in names:
            assert hasattr(names[node.value.id], node.attr), ast.unparse(node)
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call) and "..." not in ast.unparse(node)):
        if isinstance(call.func, ast.Attribute) and isinstance(call.func.value, ast.Name):
            function = getattr(names.get(call.func.value.id), call.func.attr, None)
        else:
            function = names.get(getattr(call.func, "id", None))
        ours = getattr(function, "__module__", "").startswith(("mjx_climb", "tuning"))
        if ours and not any(isinstance(argument, ast.Starred) for argument in call.args):
            keywords = {keyword.arg: None for keyword in call.keywords if keyword.arg}
            inspect.signature(function).bind(*call.args, **keywords)


@pytest.mark.nightly
def test_the_code_of_the_readme_runs(monkeypatch):
    (block,) = fences(README, "python")
    load = mc.load_scenario
    monkeypatch.setattr(mc, "load_scenario", lambda path: load(ROOT / path, {"duration": 0.3}))
    scope = {}
    exec(compile(block, "README.md", "exec"), scope)
    assert all(values.shape == (64,) for values in scope["batch"].values())
    assert scope["simulate"](mc.Gains(1.0, 1e2, 3e3))["peak_foot_force"] > 0


def test_quick_start_is_two_commands():
    section = README.split("\n## Quick start\n")[1].split("\n## ")[0]
    assert [body.split("\n") for _, body in FENCE.findall(section)] == [["make sweep", "make test", ""]]


def test_commands_of_the_readme_read_files_that_are_there_or_were_written_before():
    """The user's own are called my_...; what a command writes lies in the folder of its `--out`."""
    written = []
    for arguments in commands(README):
        words = dict(itertools.pairwise(arguments))
        outputs = {words.get("--out"), words.get("--write")}
        read = [word for word in arguments[1:] if re.search(r"\.(yaml|csv|mcap|urdf)$", word) and word not in outputs]
        for name in read:
            known = (ROOT / name).is_file() or name.startswith("my_")
            assert known or str(Path(name).parent) in written, (arguments, name)
        written += [words["--out"]] if "--out" in words else []


@pytest.mark.parametrize(
    ("question", "page", "answer"),
    [
        ("which gains for my servo", "docs/guides/hardware.md", "**2. Try shipped gains first.** `configs/gains/` has"),
        ("what does V mean", "docs/reference/metrics.md", "| `force_variation` (V) | N |"),
        ("how do I hold the base", "docs/guides/from_log_to_gains.md", "Hold the base, limbs in the air"),
        ("is my log good enough", "docs/guides/log.md", "**A log is good enough** if"),
        ("what does the red line mean", "docs/start/first_sweep.md", "**The red line is the limit of stability**"),
        ("how do I add a law", "docs/guides/law.md", "A law is a class that inherits from `mjx_climb.Law`"),
        ("does a GPU pay", "docs/guides/machines.md", "**A GPU pays from some thousand robots on**"),
        ("what is a gait's duty", "docs/explanation/gait.md", "(the share of the cycle that a limb is gripped)"),
        ("what do I load into ros2_control", "docs/guides/ros2_control.md", "**Load two files**"),
        ("how sure is does not pay", "docs/explanation/statistics.md", "A verdict takes `--seeds 4` or more"),
    ],
)
def test_a_new_user_finds_an_answer_one_click_from_the_front_page(question, page, answer):
    text = " ".join((ROOT / page).read_text("utf-8").split())
    assert answer in text and f"]({page})" in README, question


def test_every_dependency_has_its_line():
    declared = {(bare(name), "") for name in PROJECT["dependencies"]}
    for extra, names in PROJECT["optional-dependencies"].items():
        declared |= {(bare(name), extra) for name in names if bare(name) != PROJECT["name"]}
    page = (ROOT / "docs" / "project" / "dependencies.md").read_text("utf-8")
    listed = [
        (name, extra)
        for names, extra in re.findall(r"^\| ([\w ,-]+?)(?: \(`(\w+)`\))? \| [^|]+ \|$", page, re.MULTILINE)
        for name in names.split(", ")
        if name != "package"
    ]
    assert sorted(listed) == sorted(declared)


@pytest.mark.slow
def test_the_packages_import_what_they_depend_on():
    """Nothing of the extra `test`; of `compare` what looks first whether it is there."""
    modules = {"mujoco_mjx": "mujoco", "pyyaml": "yaml", "pillow": "PIL"}
    along = ("glfw", "jaxlib", "markupsafe", "pydantic_core", "warp")  # come with mujoco, jax and others
    wanted = PROJECT["dependencies"] + PROJECT["optional-dependencies"]["compare"]
    declared = [bare(name).replace("-", "_") for name in (*wanted, *along)]
    allowed = {modules.get(name, name) for name in declared} | {"mjx_climb", "tuning"} | sys.stdlib_module_names
    others = set()
    for file in (file for package in ("mjx_climb", "tuning") for file in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            others |= {(file.name, name) for name in names if name.partition(".")[0] not in allowed}
    assert not others


def bare(requirement: str) -> str:
    return re.match(r"[\w.-]+", requirement)[0]


def test_the_reference_holds_every_public_name():
    text = (ROOT / "docs" / "reference" / "mjx_climb.md").read_text("utf-8")
    missing = [name for name in mc.__all__ if not re.search(rf"\bmjx_climb\.(\w+\.)*{name}\b", text)]
    assert not missing


def test_names_that_users_write_are_those_registered():
    """The table in CONTRIBUTING: a registry, and the places where its names are checked before anything is imported."""
    control = type(mc.Scenario().control).model_fields
    assert set(get_args(control["controller"].annotation)) == {controller for controller, _ in LAWS}
    assert set(get_args(control["reading"].annotation)) == {reading for _, reading in LAWS}
    assert all(isinstance(method_of(name), Method) for name in search.METHODS)


def test_the_pages_show_every_command():
    blocks = [block for page in PAGES for block in fences(page.read_text("utf-8"), "sh")]
    assert {arguments[0] for block in blocks for arguments in commands(block)} == set(PROGRAM.commands)


def test_a_release_has_one_version():
    """In the package, in how to cite it, and first in the changelog, below what is not released yet."""
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1]
    released = re.findall(r"^## \[(\d.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert PROJECT["version"] == cited == released[0]


def test_what_an_index_shows_needs_no_other_file():
    assert all(re.match(r"https?:", link) for link in LINK.findall((ROOT / PROJECT["readme"]).read_text("utf-8")))


# --- notebooks

MACHINE = re.compile(r"/(home|root|tmp|work|Users|usr|var)/|\.venv|site-packages")


def test_every_notebook_has_its_place_on_the_site():
    pages = re.findall(r"notebooks/(\w+)\.md", (ROOT / "mkdocs.yml").read_text())
    assert sorted(pages) == sorted(path.stem for path in ROOT.glob("notebooks/*.ipynb"))


every_notebook = pytest.mark.parametrize("path", sorted(ROOT.glob("notebooks/*.ipynb")), ids=lambda path: path.stem)


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
def test_kept_as_run_with_pictures_and_nothing_of_the_machine(path):
    """One title; text that an editor of scripts has kept as comments would be a title in every line."""
    notebook = read(path)
    lines = [line for cell in notebook.cells if cell.cell_type == "markdown" for line in cell.source.splitlines()]
    assert [line for line in lines if line.startswith("# ") or line == "#"] == lines[:1]
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 3
    assert path.stat().st_size < 600_000
    assert notebook.metadata.kernelspec.name == "python3"
    assert not any(cell.metadata for cell in notebook.cells)
    text = [output.get("text", "") + output.get("data", {}).get("text/plain", "") for output in outputs]
    assert not MACHINE.search("\n".join([*text, *(cell.source for cell in notebook.cells)]))


@pytest.mark.slow
@pytest.mark.nightly
@every_notebook
def test_runs_in_a_clean_kernel(path):
    """All cells in a kernel of their own, in the root of the checkout, where a warning is an error; they print as kept.

    Searches on other processors end elsewhere.
    """
    kept, notebook = read(path), read(path)
    notebook.cells.insert(0, new_code_cell("import warnings\nwarnings.simplefilter('error')"))
    NotebookClient(notebook, kernel_name="python3", timeout=600, resources={"metadata": {"path": str(ROOT)}}).execute()
    for cell, again in zip(code_cells(kept), code_cells(notebook)[1:], strict=True):
        shown, printed = ("".join(output.get("text", "") for output in each.outputs) for each in (cell, again))
        assert not difference(shown, printed.splitlines(), MOVED), cell.source
