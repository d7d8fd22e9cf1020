"""Write hypogoal/__init__.pyi, by which editors show a stage's arguments and settings: ``python docs/signatures.py``.

The functions of stages get their signatures when they are made, where an editor does not look. So the file has them in
full, with each setting's type; what a setting means, ``hypogoal config STAGE`` says.
"""

import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import hypogoal
from hypogoal.command.stage import Stage
from hypogoal.core.config import MODELS, model_of
from hypogoal.core.presets import described

STUB = Path(hypogoal.__file__).with_suffix(".pyi")
STAGES = ("collect", "evaluate", "report", "train_baseline", "train_ensemble", "train_meta", "train_options")
IMPORTS = '''"""Signatures for editors and type checkers, written by docs/signatures.py."""

import os
from collections.abc import Sequence
from typing import Any

from hypogoal.api import compare as compare
from hypogoal.api import load_ensemble as load_ensemble
from hypogoal.api import load_options as load_options
from hypogoal.core.errors import UserError as UserError
from hypogoal.domains.gymnasium.domain import GymnasiumDomain as GymnasiumDomain
from hypogoal.look import Made as Made
from hypogoal.options.env import OptionEnv as OptionEnv
from hypogoal.options.reward import SubgoalReward as SubgoalReward

__version__: str
'''
TYPES = {"tuple": "Sequence[str] | str", "float|auto": "float | str", "float|auto|labels": "float | str"}


def stub() -> str:
    """The file's text."""
    functions = [function_of(name) for name in STAGES]
    return "".join([IMPORTS, "\n", *functions])


def function_of(name: str) -> str:
    """A stage's function."""
    made = getattr(hypogoal, name)
    stage: Stage = made.stage
    lines = [f"def {name}("]
    lines += [f"    {each}," for each in arguments_of(made, stage)]
    lines += [") -> Made: ..."]
    return "\n".join([*lines, ""])


def arguments_of(made: object, stage: Stage) -> Iterator[str]:
    """What the function takes: what it works on, where it writes, options, settings."""
    parameters = inspect.signature(made).parameters.values()  # type: ignore[arg-type]
    for parameter in parameters:
        if parameter.name == "settings":
            break
        if parameter.name == stage.options[0].name:
            yield "*"
        is_required = parameter.default is parameter.empty or (parameter.name == "out" and not stage.into)
        default = "" if is_required else " = ..."
        yield f"{parameter.name}: {type_of(parameter)}{default}"
    if stage.name in MODELS:
        for row in described(model_of(stage.name)):
            kind = row["type"]
            yield f"{row['name']}: {TYPES.get(kind, kind)} = ..."
    if "preset" not in stage.leaves_out:
        yield "**settings: Any"


def type_of(parameter: inspect.Parameter) -> str:
    """A parameter's type, without what the command line says of it; what takes a path takes a text, too."""
    annotation = parameter.annotation
    plain = getattr(annotation, "__origin__", annotation)
    text = inspect.formatannotation(plain).replace("pathlib.", "").replace("list[", "Sequence[")
    return re.sub(r"\bPath\b", "str | os.PathLike[str]", text)


if __name__ == "__main__":
    STUB.write_text(stub(), encoding="utf-8")
