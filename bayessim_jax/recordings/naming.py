"""Names for what a user's MJCF leaves without one: recordings can only refer to what has a name."""

from __future__ import annotations

import shutil
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from bayessim_jax.recordings.layout import layout_of_model
from bayessim_jax.recordings.mjcf import compile_spec, included_files, read_spec, referenced_files
from bayessim_jax.recordings.paths import element_names
from bayessim_jax.recordings.wording import CaseError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["read_named"]

KINDS = {"actuator": "actuator", "sensor": "sensor", "body": "joint", "frame": "joint"}
"""What stands in an element of MJCF that recordings refer to."""
OBJECTS = ("joint", "jointinparent", "tendon", "site", "body", "geom", "actuator", "objname", "cranksite")
"""What an actuator or a sensor may be of."""


class Read(NamedTuple):
    """An MJCF file, its `mujoco.MjSpec` and its `mujoco.MjModel`, and what was named in it, in words."""

    path: Path
    spec: Any
    model: Any
    told: str = ""


@contextmanager
def read_named(path: Path, root: Path, rename: bool = True) -> Iterator[Read]:
    """A model all of whose joints, actuators and sensors have names.

    That is the model itself where nothing lacks a name, or it is not to `rename`; else a copy for as long as the
    context lasts, with what the model refers to. An actuator is named after its joint or whatever it acts on, a sensor
    after what it is of, a joint after its body, with a number where that is taken. Elements that have no text of their
    own, such as those of a `replicate`, stay as they are. Raises `CaseError` as `read_spec` and `compile_spec` do.
    """
    read = _read(path, root)
    if not rename or not layout_of_model(read.model).unnamed:
        yield read
        return
    taken = {kind: set(element_names(read.model, kind)) for kind in set(KINDS.values())}
    with TemporaryDirectory() as folder:
        there = lambda file: Path(folder) / file.resolve().relative_to(root.resolve())  # noqa: E731
        for source in referenced_files(path, root):
            there(source).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, there(source))
        given: list[str] = []
        for source in included_files(path, root):
            text, names = _name(source.read_bytes(), taken)
            there(source).write_bytes(text)
            given += names
        listed = ", ".join(given)
        told = f"{path.name}: what had no name has one in the case: {listed}" if given else ""
        with suppress(CaseError):  # names that do not go together with those that MuJoCo makes
            read = _read(there(path), Path(folder))._replace(told=told)
        yield read


def _read(path: Path, root: Path) -> Read:
    spec = read_spec(path, root)
    return Read(path, spec, compile_spec(spec, path))


def _name(text: bytes, taken: dict[str, set[str]]) -> tuple[bytes, list[str]]:
    """The text of an MJCF file with names written into the tags that lack them, and these names with their kinds."""
    parser, open_tags, found = expat.ParserCreate(), list[tuple[str, str]](), list[tuple[int, str, str]]()

    def begin(tag: str, attributes: dict[str, str]) -> None:
        parent, holder = open_tags[-1] if open_tags else ("", "")
        kind = KINDS.get(parent, "")
        if kind and (kind != "joint" or tag in ("joint", "freejoint")) and "name" not in attributes:
            of = next((attributes[key] for key in OBJECTS if attributes.get(key)), "")
            base = {"actuator": of or tag, "sensor": f"{tag}_{of}" if of else tag, "joint": holder or tag}[kind]
            name = next(n for k in range(1, 10**6) if (n := base if k == 1 else f"{base}_{k}") not in taken[kind])
            taken[kind].add(name)
            found.append((parser.CurrentByteIndex + 1 + len(tag.encode()), kind, name))
        open_tags.append((tag, attributes.get("name", "") if tag == "body" else holder))

    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda _: open_tags.pop()
    parser.Parse(text, True)
    for place, _, name in reversed(found):
        text = text[:place] + f" name={quoteattr(name)}".encode() + text[place:]
    return text, [f"{kind}/{name}" for _, kind, name in found]
