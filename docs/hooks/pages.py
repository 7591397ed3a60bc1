"""Pages that have their source elsewhere: at the top of the repository, in the notebooks, in the program."""

from pathlib import Path

import click
import typer
from mkdocs.structure.files import File
from nbconvert import MarkdownExporter

from tuning.command_line.program import program

ROOT = Path(__file__).parents[2]
AS_THEY_ARE = ("CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff", "LICENSE")
TOP = {"index.md": "README.md", **{name: name for name in AS_THEY_ARE}}
COMMAND_LINE = "# The command line\n\nWhat `mjx-climb COMMAND --help` prints.\n"


def on_files(files, config):
    """Add the pages."""
    for page, source in TOP.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text("utf-8")))
    files.append(File.generated(config, "command_line.md", content=_command_line()))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for file in _notebook(config, path):
            files.append(file)
    return files


def _notebook(config, path: Path) -> list[File]:
    """Return the page of a notebook, as it was last run, and its pictures."""
    text, resources = MarkdownExporter().from_filename(str(path))
    made = []
    for name, content in resources["outputs"].items():
        unique = f"{path.stem}_{name}"
        text = text.replace(f"]({name})", f"]({unique})")
        made.append(File.generated(config, f"notebooks/{unique}", content=content))
    text = f"---\nhide: [toc]\n---\n{text}"  # its 120 columns take all the room there is
    return [File.generated(config, f"notebooks/{path.stem}.md", content=text), *made]


def _command_line() -> str:
    """Return the help of every command."""
    whole = typer.main.get_command(program())
    top = click.Context(whole, info_name="mjx-climb", terminal_width=80, **whole.context_settings)
    parts = [COMMAND_LINE, _fenced(whole.get_help(top))]
    for name, command in whole.commands.items():
        parts.append(f"## {name}\n\n{_fenced(command.get_help(click.Context(command, top, name)))}")
    return "\n".join(parts)


def _fenced(text: str) -> str:
    return f"```text\n{text}\n```\n"
