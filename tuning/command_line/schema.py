"""`mjx-climb schema`: what a scenario may hold, for editors."""

from pathlib import Path
from typing import Annotated

import typer


def schema(
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File to write.", show_default="standard output")
    ] = None,
) -> None:
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
    if out is None:
        typer.echo(text, nl=False)
    else:
        dataset.write_text_atomically(out, text)
