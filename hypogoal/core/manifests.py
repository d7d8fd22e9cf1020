"""Manifests: the schema of ``manifest.json`` and its checksum, checked before anything in it is used (Spec A8, G2)."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hypogoal.core.errors import UserError
from hypogoal.core.files import parse_json, plain_name, plain_names, read_bytes
from hypogoal.core.schemas import Schema, is_count, is_list, is_object, is_table, is_text, misfit

FORMAT_VERSION = 2
CHECKSUM = "sha256"
TOOK = "took"  # seconds and memory, the one key in which two runs of a command differ
MANIFEST = "manifest.json"
MAX_MANIFEST_BYTES = 16 * 2**20
AGAIN = "Make the artefact again."
LOG = "metrics.jsonl"
INPUT = ("path", "relative", "kind", "sha256")
NUMBERS_CSV = "numbers.csv"


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest in a file, with all common keys and the settings that other stages read checked.

    One that is not JSON, malformed, of another format or changed since it was written is a ``UserError``.
    """
    data = read_bytes(path, "the manifest is", AGAIN)
    manifest = parse_json(data.decode(errors="surrogateescape"), path, "the manifest is", AGAIN)
    if not isinstance(manifest, dict):
        raise UserError("the manifest is not a JSON object", path, AGAIN)
    version = manifest.get("format")
    if type(version) is int and version > FORMAT_VERSION:
        do = "Upgrade hypogoal."
        raise UserError(f"format {version} is newer than this hypogoal reads ({FORMAT_VERSION})", path, do)
    if type(version) is int and version < FORMAT_VERSION:
        raise UserError(f"format {version} is of an earlier hypogoal, which this one does not read", path, AGAIN)
    if data != sealed(manifest):
        raise UserError("the manifest was changed since it was written, its checksum does not match", path, AGAIN)
    manifest.pop(CHECKSUM, None)
    return _checked(manifest, path)


def sealed(manifest: Mapping[str, Any]) -> bytes:
    """The bytes of a manifest's file; the last key is the checksum of the text without that key.

    It detects accidents, not forgers: whoever writes another manifest can seal it, too.
    """
    bare = {key: value for key, value in manifest.items() if key != CHECKSUM}
    return _text({**bare, CHECKSUM: hashlib.sha256(_text(bare)).hexdigest()})


def digest_of(path: Path) -> str:
    """The sha256 of a manifest's text without ``took``, by which artefacts know their inputs."""
    data = read_bytes(path, "the manifest is", AGAIN)
    manifest = parse_json(data.decode(errors="surrogateescape"), path, "the manifest is", AGAIN)
    if isinstance(manifest, dict) and TOOK in manifest:
        data = sealed({key: value for key, value in manifest.items() if key != TOOK})
    return hashlib.sha256(data).hexdigest()


def _text(manifest: Mapping[str, Any]) -> bytes:
    return (json.dumps(manifest, indent=1, allow_nan=False) + "\n").encode()


def check_writable(manifest: dict[str, Any], out: Path) -> None:
    """Refuse (``UserError``), before any work, a manifest that :func:`read_manifest` would refuse."""
    do = "Choose another value, or a name in UTF-8."
    text = json.dumps(manifest)
    try:
        _checked(json.loads(text), out)
        parse_json(text, out, "the manifest would be", do)
    except UserError as error:
        raise UserError(f"this could not be read again ({error.what})", out, do) from None


def _checked(manifest: dict[str, Any], path: Path) -> dict[str, Any]:
    if key := misfit(manifest, WANTED):
        raise UserError(f"the manifest's {key!r} is missing or malformed", path, AGAIN)
    if key := misfit(manifest["config"], {}, SETTINGS):
        raise UserError(f"the manifest's setting {key!r} is malformed", path, AGAIN)
    settings = {**manifest["config"], **manifest["config"].get("domain_config", {})}
    for key, without in GONE.items():
        if settings.get(key, without) != without:
            raise UserError(f"it was made with {key}={settings[key]}, which is gone since 0.24", path, AGAIN)
    return manifest


def _size(value: Any) -> bool:
    return is_count(value) and 0 < value < 1 << 16


# Settings of 0.23 without which what was made would be taken for something else, and the values that changed nothing.
GONE = {
    "actions": "all",
    "encoder": "separate",
    "initiation": "anywhere",
    "keyring": True,
    "policy_pixels": "all",
    "policy_view": "full",
}
# WANTED must be in every manifest; SETTINGS, read by other stages, are checked if present.
WANTED: Schema = {
    "kind": plain_name,
    "format": lambda value: type(value) is int,
    "config": lambda value: isinstance(value, dict),
    "seed": is_count,
    "inputs": is_list(is_object(dict.fromkeys(INPUT, is_text))),
    "files": is_table(is_text),
}
SETTINGS: Schema = {
    "sub_goals": plain_names,
    "members": _size,
    "observation_shape": lambda value: isinstance(value, list) and all(map(_size, value)),
    "observation_dtype": is_text,
    "view_settings": is_list(is_text),
    "domain_config": lambda value: isinstance(value, dict),
    "mask_reached": lambda value: isinstance(value, bool),
    **dict.fromkeys(("steps", "options_steps", "layout_seed", "option_timeout", "max_episode_steps"), is_count),
    **dict.fromkeys(("ended_at", "options_ended_at"), is_count),
    **dict.fromkeys(("domain", "network", "setting", "agent", "termination", "chooser", "start"), is_text),
    **dict.fromkeys(("view", "diversity", "layouts"), is_text),
}
