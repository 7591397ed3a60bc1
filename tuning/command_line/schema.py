"""`mjx-climb schema`: what a scenario may hold, for editors."""

from pathlib import Path

import typer

from tuning.command_line.from_models import command
from tuning.problem.settings import Options, setting


class Schema(Options):
    """Where the schema goes."""

    out: Path | None = setting(None, "file to write; null: standard output", metavar="FILE")


def schema(asked: Schema) -> None:
    """Print the JSON schema of scenarios: every key with its type, range, unit and default.

    An editor with YAML support (VS Code, Neovim, Emacs: yaml-language-server) completes and checks a scenario whose
    first line names the file:

    \b
      # yaml-language-server: $schema=scenario.schema.json

    \b
    Examples:
      mjx-climb schema --out scenario.schema.json
    """
    import json

    import mjx_climb as mc
    from mjx_climb.files import dataset

    tree = {"$schema": "https://json-schema.org/draft/2020-12/schema", **mc.Scenario.model_json_schema()}
    text = json.dumps(tree, indent=2) + "\n"
    if asked.out is None:
        typer.echo(text, nl=False)
    else:
        dataset.write_text_atomically(asked.out, text)


COMMAND = command(schema)
