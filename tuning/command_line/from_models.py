"""Commands made from settings: every field of a pydantic model becomes an argument or option of typer, described there.

A command is a function of models alone. Each is built from the words typed, so that `model_fields_set` tells it from
the defaults. See `tuning.problem.settings.setting` for a field's default, help and unit; its bounds are checked and
shown.
"""

import ast
import inspect
import re
import types
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import typer
from pydantic import BaseModel, BeforeValidator, ValidationError
from pydantic.fields import FieldInfo

from mjx_climb.scenario import shipped
from tuning.command_line.program import InputError
from tuning.problem.search import METHODS
from tuning.problem.settings import Shell, explained

REPEATABLE = "; may be given several times"
_WITH_FILES = {"config": shipped.names, "ensemble": shipped.ensembles, "hardware": shipped.profiles}


class Form(NamedTuple):
    """A function of models, and where its options are fields: the name of a parameter, and the model."""

    function: Callable[..., None]
    models: Mapping[str, type[BaseModel]]  # by the name of a parameter
    places: Mapping[str, tuple[str, type[BaseModel]]]  # by the name of an option

    @classmethod
    def of(cls, function: Callable[..., None]) -> "Form":
        """Return the form of a function whose parameters are models."""
        models: dict[str, type[BaseModel]] = {}
        places: dict[str, tuple[str, type[BaseModel]]] = {}
        for taken, hint in get_type_hints(function, include_extras=True).items():
            if taken != "return":
                model, *chosen = get_args(hint) if get_origin(hint) is Annotated else (hint,)
                but = {word[1:] for word in chosen if word.startswith("-")}
                models[taken] = model
                names = model.model_fields if but or not chosen else chosen
                places |= {name: (taken, model) for name in names if name not in but}
        return cls(function, models, places)

    def field(self, name: str) -> FieldInfo:
        """Return the field of an option."""
        return self.places[name][1].model_fields[name]


def command(
    question: str, folder: str = "", forms: Mapping[str, Callable[..., None]] = MappingProxyType({})
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that makes a command of typer of a function, with a parameter for each field of its models.

    Of `Annotated[Model, "name"]` these fields alone are options, of "-name" all but these.
    `question` is the one that the command answers; the program finds the command by it, first in the decorator.
    `folder` is the default of `--out` in words. `forms` are functions of models that run in place of the decorated
    one: by the option that asks for them, named twice where it has to be typed more than once. An option that is not of
    the form that runs is refused.
    """

    def made_of(function: Callable[..., None]) -> Callable[..., None]:
        every = {"": Form.of(function), **{key: Form.of(form) for key, form in forms.items()}}
        # by the name of an option, as repeated where some form repeats it
        shown: dict[str, tuple[type[BaseModel], FieldInfo]] = {}
        for form in every.values():
            for name, (_, model) in form.places.items():
                if name not in shown or (_repeated(form.field(name)) and not _repeated(shown[name][1])):
                    shown[name] = model, form.field(name)

        def called(context: typer.Context, **values: Any) -> None:
            sources = {name: context.get_parameter_source(name) for name in shown}
            typed = [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]
            key = _chosen(every, typed, values)
            form = every[key]
            for name in typed:
                if name not in form.places:
                    others = [_asking(key, shown) for key, other in every.items() if key and name in other.places]
                    unused = f"none with {_asking(key, shown)}, which does not use it"
                    expected = unused if key else f"{' or '.join(others)} with it"
                    raise InputError(f"{_flag(name, shown[name][1])}: expected {expected}")
            for name in (name for name in form.places if form.field(name).is_required() and name not in typed):
                shell, option = _shell(form.field(name)), f"option '{_flag(name, form.field(name))}'"
                context.fail("Missing " + (f"argument '{shell.metavar}'." if shell.argument else f"{option}."))
            read: dict[str, dict[str, Any]] = {taken: {} for taken in form.models}
            for name in typed:
                read[form.places[name][0]][name] = _read(name, form.field(name), values[name], _asking(key, shown))
            form.function(**{taken: made(model, read[taken]) for taken, model in form.models.items()})

        parameters = [inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)]
        last = [*every[""].models.values()][-1]  # the output, below the forms' own options
        for name, (model, field) in sorted(shown.items(), key=lambda each: each[1][0] is last):
            needed = all(name in form.places and form.field(name).is_required() for form in every.values())
            asks = name in {key.partition(" ")[0] for key in every} and not _repeated(field)
            words = folder if name == "out" else ""
            parameters.append(_parameter(name, field, words, _about(model), needed=needed, asks=asks))
        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        called.__name__, called.__doc__ = function.__name__, function.__doc__
        called.options = {key: tuple(form.places) for key, form in every.items()}  # type: ignore[attr-defined]
        return called

    return made_of


def _chosen(every: Mapping[str, Form], typed: Collection[str], values: Mapping[str, Any]) -> str:
    """Return the key of the first form that is asked for, "" for the command's own."""
    for key in every:
        name, *again = key.split() or [""]
        if name in typed and (not again or len(values[name]) > 1):
            return key
    return ""


def _asking(key: str, shown: Mapping[str, tuple[type[BaseModel], FieldInfo]]) -> str:
    """Return the words that ask for a form: "--against", "several --law"; "" for the command's own."""
    name, *again = key.split() or [""]
    return f"{'several ' * bool(again)}{_flag(name, shown[name][1])}" if name else ""


def _about(model: type[BaseModel]) -> str:
    """Return the beginning of a model's docstring, the heading of its options."""
    return re.split("[.:,]", model.__doc__ or "")[0]


def _repeated(field: FieldInfo) -> bool:
    return get_origin(_kind(field)) in (dict, list, tuple)


def made(model: type[BaseModel], values: Mapping[str, Any]) -> BaseModel:
    """Return a model of the words typed; InputError in one line: the option, expected and got."""
    try:
        return model.model_validate(dict(values), strict=False)
    except ValidationError as invalid:
        key, reason = explained(invalid)
        raise InputError(f"{in_options(key, model)}: {reason}" if key else reason) from None


def in_options(key: str, model: type[BaseModel]) -> str:
    """Return the option of a setting's key, "--pin x" of "pins.x"; the key itself where the model has none."""
    name, *inner = key.split(".")
    if name not in model.model_fields:
        return key
    field = model.model_fields[name]
    parts = (_shell(field).metavar or "").rpartition("=")[2].split(":")  # as LOW:HIGH
    place = int(inner.pop()) if inner and inner[-1].isdecimal() else None
    part = "" if place is None or len(parts) == 1 else parts[place]
    return " ".join(filter(None, [_flag(name, field), ".".join(inner), part]))


def _flag(name: str, field: FieldInfo) -> str:
    return (_shell(field).flag or f"--{name.replace('_', '-')}").partition("/")[0]


def _shell(field: FieldInfo) -> Shell:
    return next((extra for extra in field.metadata if isinstance(extra, Shell)), Shell())


def _kind(field: FieldInfo) -> Any:
    """Return the type of a field without None; str where a validator reads a text."""
    if any(isinstance(extra, BeforeValidator) for extra in field.metadata):
        return str
    if get_origin(field.annotation) in (Union, types.UnionType):
        kind = get_args(field.annotation)[0]  # the others are None, or for Python alone
        return get_args(kind)[0] if get_origin(kind) is Annotated else kind
    return field.annotation


def _read(name: str, field: FieldInfo, value: Any, asking: str) -> Any:
    """Return a value of typer's as the model takes it: a mapping of NAME=VALUE pairs, one value of several."""
    kind = _kind(field)
    if isinstance(value, list) and not _repeated(field):
        if len(value) > 1:
            raise InputError(f"{_flag(name, field)}: expected one {f'with {asking}' * bool(asking)}, got {len(value)}")
        return value[0]
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


def _parameter(
    name: str, field: FieldInfo, default_in_words: str, heading: str, *, needed: bool, asks: bool
) -> inspect.Parameter:
    """Return a field as typer declares it: flags and paths as such, all else as text for the model to read.

    `needed`: with any other words; `asks`: it asks for a form of the command, which no default does.
    """
    shell, kind = _shell(field), _kind(field)
    default = None if asks and kind is not bool else field.get_default()
    text, _, null = (field.description or "").partition("; null: ")
    choices = get_args(kind) if get_origin(kind) is Literal else ()
    repeated = _repeated(field)
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
        "rich_help_panel": heading,
        "autocompletion": _completion(shell.complete, choices) if choices or shell.complete else None,
    }
    declared = typer.Argument(**how) if shell.argument else typer.Option(shell.flag or _flag(name, field), **how)
    annotation = list[plain] if repeated else plain  # type: ignore[valid-type]
    if needed:
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
    """Return the completion of one of some choices, or of a value that `Shell.complete` names."""

    def complete(incomplete: str) -> list[str]:
        words = [*(choices or (METHODS if kind == "method" else metric_names()))]
        if kind in _WITH_FILES:  # YAML files of this folder; below other folders the shell itself completes
            files = sorted(str(file) for file in Path().iterdir() if file.suffix in (".yaml", ".yml"))
            words = [*_WITH_FILES[kind](), *files]
        elif kind == "key":
            from mjx_climb.scenario.messages import keys
            from mjx_climb.scenario.model import Scenario

            words = [f"{name}=" for name in keys(Scenario)]
        return [word for word in words if word.startswith(incomplete)]

    return complete
