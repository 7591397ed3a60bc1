"""Commands made from settings: every field of a pydantic model becomes an argument or option of typer, described there.

A command is a function of models alone. Each is built from what was typed, so that `model_fields_set` tells it from the
defaults. See `tuning.problem.settings.setting` for what is said of a field; its bounds are checked and shown.
"""

import ast
import inspect
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import typer
from pydantic import BaseModel, BeforeValidator, ValidationError
from pydantic.fields import FieldInfo

from mjx_climb.scenario import shipped
from tuning.command_line.program import InputError
from tuning.problem.settings import Shell, explained

REPEATABLE = "; may be given several times"
_WITH_FILES = {"config": shipped.names, "ensemble": shipped.ensembles, "hardware": shipped.profiles}


def command(folder: str = "") -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that makes what typer takes of a function, with a parameter for each field of its models.

    Of `Annotated[Model, "name"]` these fields alone are options, of "-name" all but these.
    `folder` is what `--out` is by default, in words.
    """

    def made_of(function: Callable[..., None]) -> Callable[..., None]:
        models: dict[str, type[BaseModel]] = {}  # by the name of a parameter
        places: dict[str, tuple[str, type[BaseModel]]] = {}  # by the name of an option: a parameter and its model
        for taken, hint in get_type_hints(function, include_extras=True).items():
            if taken != "return":
                model, *chosen = get_args(hint) if get_origin(hint) is Annotated else (hint,)
                but = {word[1:] for word in chosen if word.startswith("-")}
                models[taken] = model
                names = model.model_fields if but or not chosen else chosen
                places |= {name: (taken, model) for name in names if name not in but}

        def called(context: typer.Context, **values: Any) -> None:
            typed: dict[str, dict[str, Any]] = {taken: {} for taken in models}
            for name, (taken, model) in places.items():
                source = context.get_parameter_source(name)
                if source is not None and source.name == "COMMANDLINE":
                    typed[taken][name] = _read(name, model.model_fields[name], values[name])
            function(**{taken: made(model, typed[taken]) for taken, model in models.items()})

        first = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        parameters = [
            _parameter(name, model.model_fields[name], folder if name == "out" else "")
            for name, (_, model) in places.items()
        ]
        parameters = [first, *sorted(parameters, key=lambda each: each.default is not inspect.Parameter.empty)]
        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        called.__name__, called.__doc__ = function.__name__, function.__doc__
        return called

    return made_of


def made(model: type[BaseModel], values: Mapping[str, Any]) -> BaseModel:
    """Return a model of what was typed; InputError in one line: the option, what was expected and what was got."""
    try:
        return model(**values)
    except ValidationError as invalid:
        key, reason = explained(invalid)
        raise InputError(in_options(f"{key}: {reason}" if key else reason, model)) from None


def in_options(message: str, model: type[BaseModel]) -> str:
    """Return a message that begins with the key of a setting, as "pins.x: ...", with its option, as "--pin x: ..."."""
    key, colon, reason = message.partition(": ")
    name, *inner = key.split(".")
    if not colon or name not in model.model_fields:
        return message
    field = model.model_fields[name]
    parts = (_shell(field).metavar or "").rpartition("=")[2].split(":")  # as LOW:HIGH
    place = int(inner.pop()) if inner and inner[-1].isdecimal() else None
    part = "" if place is None or len(parts) == 1 else parts[place]
    return f"{' '.join(filter(None, [_flag(name, field), '.'.join(inner), part]))}: {reason}"


def _flag(name: str, field: FieldInfo) -> str:
    return (_shell(field).flag or f"--{name.replace('_', '-')}").partition("/")[0]


def _shell(field: FieldInfo) -> Shell:
    return next((extra for extra in field.metadata if isinstance(extra, Shell)), Shell())


def _kind(field: FieldInfo) -> Any:
    """Return the type of a field without None; str where a validator reads a text."""
    if any(isinstance(extra, BeforeValidator) for extra in field.metadata):
        return str
    if get_origin(field.annotation) in (Union, types.UnionType):
        return get_args(field.annotation)[0]  # the others are None, or for Python alone
    return field.annotation


def _read(name: str, field: FieldInfo, value: Any) -> Any:
    """Return what the model takes in place of what typer read: a mapping of NAME=VALUE pairs."""
    kind = _kind(field)
    if get_origin(kind) is not dict:
        return value
    found: dict[str, Any] = {}
    for pair in value:
        key, equals, text = pair.partition("=")
        if not equals or key.strip() in found:
            expected = f"{_shell(field).metavar}, each name once"
            raise InputError(f"{_flag(name, field)}: expected {expected}, got {pair!r}")
        if get_origin(get_args(kind)[1]) is tuple:
            try:
                found[key.strip()] = parts_of(text, (_shell(field).metavar or "").rpartition("=")[2])
            except ValueError as error:
                raise InputError(f"{_flag(name, field)} {key.strip()}: {error}") from None
        else:
            found[key.strip()] = text
    return found


def parts_of(text: str, form: str) -> list[str]:
    """Return the parts of a text of a form such as LOW:HIGH.

    Raises:
        ValueError: it has more parts or fewer.
    """
    parts = text.split(":")
    if len(parts) != len(form.split(":")):
        raise ValueError(f"expected {form}, got {text!r}")
    return parts


def _parameter(name: str, field: FieldInfo, default_in_words: str) -> inspect.Parameter:
    """Return a field as typer declares it: what is no flag and no path is a text for the model to read."""
    shell, kind, default = _shell(field), _kind(field), field.get_default()
    text, _, null = (field.description or "").partition("; null: ")
    choices = get_args(kind) if get_origin(kind) is Literal else ()
    repeated = get_origin(kind) in (dict, list, tuple)
    plain = kind if kind in (bool, Path) else Path if repeated and get_args(kind)[0] is Path else str
    # the range is shown where it has two ends, or begins above 1
    ends = {name: getattr(extra, name) for extra in field.metadata for name in ("ge", "le") if hasattr(extra, name)}
    bounds = f", {ends['ge']} or more" if ends.get("ge", 0) > 1 else ""
    if len(ends) == 2:
        bounds = f", {ends['ge']} to {ends['le']}"
    shown = default_in_words or shell.default_in_words or null
    if not isinstance(default, str | int | float | Path) or (shown and kind is not bool):
        default = None
    how: dict[str, Any] = {
        "help": f"{text[:1].upper()}{text[1:]}{bounds}{REPEATABLE * (repeated and not shell.argument)}.",
        "metavar": shell.metavar or (f"<{'|'.join(choices)}>" if choices else "N" if kind in (int, float) else None),
        "show_default": shown or not (default is None or default is False),
        "autocompletion": _completion(shell.complete, choices) if choices or shell.complete else None,
    }
    declared = typer.Argument(**how) if shell.argument else typer.Option(shell.flag or _flag(name, field), **how)
    annotation = list[plain] if repeated else plain  # type: ignore[valid-type]
    if field.is_required():
        default = inspect.Parameter.empty
    elif default is None:
        annotation = annotation | None
    elif plain is str:
        default = str(default)
    annotation = Annotated[annotation, declared]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def metric_names() -> list[str]:
    """Return the names of the shipped metrics that are no failures, for completion.

    They are read in the source: a key press waits for them, and importing the metrics takes seconds.
    """
    source = (Path(inspect.getfile(shipped)).parents[1] / "walk" / "metrics.py").read_text("utf-8")
    assigned = (node for node in ast.parse(source).body if isinstance(node, ast.Assign))
    values = {node.targets[0].id: node.value for node in assigned if isinstance(node.targets[0], ast.Name)}
    strings = (node for node in ast.walk(values["METRICS"]) if isinstance(node, ast.Call) and node.args)
    names = [call.args[0].value for call in strings if isinstance(call.args[0], ast.Constant)]
    return [name for name in names if isinstance(name, str) and name not in ast.literal_eval(values["FAILURES"])]


def _completion(kind: str | None, choices: tuple[str, ...]) -> Callable[[str], list[str]]:
    """Return what completes one of some choices, or what `Shell.complete` names."""

    def complete(incomplete: str) -> list[str]:
        words = [*(choices or metric_names())]
        if kind in _WITH_FILES:  # YAML files of this folder; below other folders the shell itself completes
            files = sorted(str(file) for file in Path().iterdir() if file.suffix in (".yaml", ".yml"))
            words = [*_WITH_FILES[kind](), *files]
        elif kind == "key":
            from mjx_climb.scenario.messages import keys
            from mjx_climb.scenario.model import Scenario

            words = [f"{name}=" for name in keys(Scenario)]
        return [word for word in words if word.startswith(incomplete)]

    return complete
