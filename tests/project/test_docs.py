"""What the documentation shows is so: links, paths, commands, code, dependencies."""

import ast
import importlib
import inspect
import pydoc
import re
import shlex
import sys
import tomllib
from pathlib import Path
from typing import get_args

import pytest
import typer

import mjx_climb as mc
from mjx_climb.control import LAWS
from tuning.command_line import options
from tuning.command_line.program import program
from tuning.problem import search
from tuning.searches.methods import METHODS

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
PROGRAM = typer.main.get_command(program())
LINK = re.compile(r"\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`([^`\n]+(?:\n[^`\n]+)?)`")
PATH = re.compile(r"(?:\.ci|configs|docs|mjx_climb|notebooks|tests|tuning)/[\w./-]*")


def fences(page: Path, *languages: str) -> list[str]:
    return [body for language, body in FENCE.findall(page.read_text("utf-8")) if language in languages]


def inline(page: Path) -> list[str]:
    return [" ".join(code.split()) for code in INLINE.findall(FENCE.sub("", page.read_text("utf-8")))]


def pages_with(found):
    """Run a test over the pages in which there is something for it."""
    pages = list(filter(found, PAGES))
    assert pages
    return pytest.mark.parametrize("page", pages, ids=lambda page: str(page.relative_to(ROOT)))


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and Python-Markdown make them."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text("utf-8")), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


def commands(text: str) -> list[list[str]]:
    """Return the arguments of the lines that call the program."""
    lines = (line.strip() for line in text.replace("\\\n", " ").splitlines())
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("mjx-climb ")]


def parsed(arguments: list[str]) -> dict:
    """Return the values of a call, which must be complete."""
    name, *rest = arguments
    assert name in PROGRAM.commands, f"no such command: {name}"
    return PROGRAM.commands[name].make_context(name, rest).params


def links(page: Path) -> list[str]:
    """Return the links to other places of the repository."""
    found = LINK.findall(FENCE.sub("", page.read_text("utf-8")))
    return [link for link in found if not re.match(r"[a-z]+:", link)]


@pages_with(links)
def test_links_lead_somewhere(page):
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def paths(page: Path) -> list[str]:
    return [word for code in inline(page) for word in code.split() if PATH.fullmatch(word)]


@pages_with(paths)
def test_paths_exist(page):
    assert [word for word in paths(page) if not (ROOT / word).exists()] == []


@pages_with(lambda page: "mjx-climb " in page.read_text("utf-8"))
def test_commands_are_understood(page):
    """Calls in blocks are complete, with keys that a scenario has; those within a sentence may be cut short."""
    for arguments in (call for block in fences(page, "sh") for call in commands(block)):
        values = parsed(arguments)
        config = values.get("config")
        if config is not None and Path(config).parts[0] == "configs":
            mc.load_scenario(ROOT / config, values.get("changes") or ())
    for name, *rest in (shlex.split(code)[1:] for code in inline(page) if code.startswith("mjx-climb ")):
        if name.isupper():  # stands for any
            continue
        assert name in PROGRAM.commands or name.startswith("--"), name
        known = {option for parameter in PROGRAM.commands.get(name, PROGRAM).params for option in parameter.opts}
        assert {word.partition("=")[0] for word in rest if word.startswith("--")} <= known | {"--help"}, rest


@pytest.mark.parametrize("name", PROGRAM.commands)
def test_examples_in_the_help_are_understood(name):
    found = commands(inspect.cleandoc(PROGRAM.commands[name].help).replace("\b", ""))
    assert found
    for arguments in found:
        parsed(arguments)


def made(page: Path) -> set[str]:
    """Return the targets of make that a page names."""
    shown = {target for block in fences(page, "sh") for target in re.findall(r"^make ([\w-]+)", block, re.MULTILINE)}
    return shown | {code.split()[1] for code in inline(page) if re.match(r"make [\w-]+$", code)}


@pages_with(made)
def test_make_targets_exist(page):
    assert made(page) <= set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


@pages_with(lambda page: fences(page, "sh", "text", "python", "yaml"))
def test_code_is_as_narrow_as_its_box(page):
    """The site shows 112 columns on a window of 1400 px, see `tests/project/test_site.py`."""
    assert not [
        line for body in fences(page, "sh", "text", "python", "yaml") for line in body.split("\n") if len(line) > 112
    ]


@pages_with(lambda page: fences(page, "python"))
def test_code_uses_names_that_exist(page, monkeypatch):
    monkeypatch.syspath_prepend(page.parent)
    for block in fences(page, "python"):
        check_names(block)


def dotted(page: Path) -> list[str]:
    """Return the names of ours that a page shows in full, but for the changelog's, which are of former times."""
    shown = [code.partition("(")[0] for code in inline(page) if page.name != "CHANGELOG.md"]
    shown += re.findall(r"^::: (.+)$", page.read_text("utf-8"), re.MULTILINE)
    return list(filter(re.compile(r"(?:mjx_climb|tuning)(?:\.\w+)+").fullmatch, shown))


@pages_with(dotted)
def test_names_in_sentences_and_in_the_reference_exist(page):
    assert [name for name in dotted(page) if pydoc.locate(name) is None] == []


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
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        function = called(call, names)
        if function is not None and not any(isinstance(argument, ast.Starred) for argument in call.args):
            keywords = {keyword.arg: None for keyword in call.keywords if keyword.arg}
            inspect.signature(function).bind(*call.args, **keywords)


def called(call: ast.Call, names: dict):
    """Return the function of these packages that a call in a block means, None where it is none of theirs."""
    if isinstance(call.func, ast.Attribute) and isinstance(call.func.value, ast.Name):
        function = getattr(names.get(call.func.value.id), call.func.attr, None)
    else:
        function = names.get(getattr(call.func, "id", None))
    ours = getattr(function, "__module__", "").startswith(("mjx_climb", "tuning"))
    return function if ours and "..." not in ast.unparse(call) else None


@pytest.mark.slow
def test_the_code_of_the_readme_runs(monkeypatch):
    (block,) = fences(ROOT / "README.md", "python")
    load = mc.load_scenario
    monkeypatch.setattr(mc, "load_scenario", lambda path: load(ROOT / path, {"duration": 0.2}))
    scope = {}
    exec(compile(block, "README.md", "exec"), scope)
    assert all(values.shape == (64,) for values in scope["batch"].values())
    assert scope["simulate"](mc.Gains(1.0, 1e2, 3e3))["peak_foot_force"] > 0


def test_quick_start_is_two_commands():
    section = (ROOT / "README.md").read_text("utf-8").split("\n## Quick start\n")[1].split("\n## ")[0]
    assert [body.split("\n") for _, body in FENCE.findall(section)] == [["make sweep", "make test", ""]]


def test_every_dependency_has_its_line():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {(bare(name), "") for name in project["dependencies"]}
    for extra, names in project["optional-dependencies"].items():
        declared |= {(bare(name), extra) for name in names if bare(name) != project["name"]}
    section = (ROOT / "README.md").read_text("utf-8").split("\n## Dependencies\n")[1].split("\n## ")[0]
    listed = [
        (name, extra)
        for names, extra in re.findall(r"^\| ([\w ,-]+?)(?: \(`(\w+)`\))? \| [^|]+ \|$", section, re.MULTILINE)
        for name in names.split(", ")
        if name != "package"
    ]
    assert sorted(listed) == sorted(declared)


def test_the_packages_import_what_they_depend_on():
    """Nothing of the extra `test`; of `compare` what looks first whether it is there."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    modules = {"mujoco_mjx": "mujoco", "pyyaml": "yaml", "pillow": "PIL"}
    along = ("glfw", "jaxlib", "markupsafe", "pydantic_core", "warp")  # come with mujoco, jax and others
    wanted = project["dependencies"] + project["optional-dependencies"]["compare"]
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
    assert set(get_args(options.ControllerName)) == {controller for controller, _ in LAWS}
    assert set(get_args(control["reading"].annotation)) == {reading for _, reading in LAWS}
    assert set(search.METHODS) == set(METHODS)


def test_the_readme_names_every_command():
    shown = {arguments[0] for block in fences(ROOT / "README.md", "sh") for arguments in commands(block)}
    assert shown == set(PROGRAM.commands)


def test_what_an_index_shows_needs_no_other_file():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert all(re.match(r"https?:", link) for link in LINK.findall((ROOT / project["readme"]).read_text("utf-8")))
