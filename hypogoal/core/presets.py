"""Presets: files with settings by stage, which are read and written.

[train-ensemble]
steps = 300  # gradient steps of a training
"""

import inspect
import json
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Union, get_args, get_origin

from hypogoal.core.config import DOMAIN, STAGES, Config, Values, details_of, homes_of, parts_of, validated
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading

PRESETS = Path(__file__).parents[1] / "presets"
TABLES = (*STAGES, "run")  # the tables that a preset may have


def preset(name: str | None, stage: str, domain: str = DOMAIN) -> dict[str, Any]:
    """Return the table ``[stage]`` of the preset ``name``, which is empty if there is no such table.

    ``name`` is a preset of the package or a TOML file. Presets of the package are those of ``domain``, or of DoorKey if
    the domain has none. Raises ``UserError`` if there is no such preset, or if it has a table of another name than a
    stage's.
    """
    if name is None:
        return {}
    folder = PRESETS / domain
    if not folder.is_dir():
        folder = PRESETS / DOMAIN
    path = Path(name) if name.endswith(".toml") else folder / f"{name}.toml"
    if not path.exists():
        names = sorted(file.stem for file in folder.iterdir())
        raise UserError("no such preset", name, f"Choose one of {', '.join(names)}, or give a .toml file.")
    with reading(path, "Mend the file.", "the preset"):
        text = path.read_text(encoding="utf-8-sig")
        tables = tomllib.loads(text)
    for key, table in tables.items():
        if key not in TABLES or not isinstance(table, dict):
            do = f"A preset has tables for {', '.join(TABLES)}."
            raise UserError("no such table in a preset", f"{key} in {name}", do)
    return dict(tables.get(stage, {}))


def described(model: type[Config], *layers: tuple[Values, str]) -> list[dict[str, Any]]:
    """Return a description of every setting of the model, then of its parts.

    A layer has values that replace defaults, and the source of these values.
    """
    replacing: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for values, source in layers:
        replacing |= {name: value for name, value in values.items() if value is not None}
        sources |= dict.fromkeys(values, source)
    rows = {}
    for home in homes_of(model):
        of_home = {name: value for name, value in replacing.items() if name in home.model_fields}
        defaults = validated(home, of_home, model, "").model_dump(mode="json")
        for origin in home.__mro__:
            for name in inspect.get_annotations(origin):
                field = home.model_fields.get(name)
                if field is None or name in rows or name in parts_of(home):
                    continue
                details = details_of(field)
                rows[name] = {
                    "name": name,
                    "type": _type_text(field.annotation),
                    "default": defaults[name],
                    "unit": details.unit,
                    "meaning": field.description or "",
                    "source": sources.get(name, details.source),
                    "allowed": str(details),
                    "part": (origin.__doc__ or "").partition(".")[0],
                }
    return [*rows.values()]


def as_toml(stage: str, rows: Iterable[Values]) -> str:
    """Return settings, as :func:`described` gives them, as the text of a preset that the user can edit."""
    lines = [f"[{stage}]"]
    for row in rows:
        value = json.dumps(row["default"], ensure_ascii=False)
        lines.append(f"{row['name']} = {value}  # {row['meaning']}")
    return "\n".join(lines) + "\n"


def _type_text(kind: Any) -> str:
    """Return a setting's type as a text: ``float``, ``tuple[int, ...]``, ``float|auto``."""
    if get_origin(kind) is not Union:
        return getattr(kind, "__name__", str(kind))
    number, words = get_args(kind)
    return "|".join([number.__name__, *get_args(words)])
