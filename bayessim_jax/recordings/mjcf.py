"""Reading a user's MJCF: only from its own folder, and with one line where it does not compile."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from bayessim_jax.recordings.wording import CaseError, quote

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["compile_spec", "import_mujoco", "read_spec", "referenced_files"]

FOLDERS = {"mesh": "meshdir", "skin": "meshdir", "hfield": "meshdir", "flexcomp": "meshdir", "texture": "texturedir"}


def import_mujoco() -> Any:
    """The MuJoCo module, imported where a model is first needed; raises `CaseError` where it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise CaseError("model", "reading it needs MuJoCo", "install it with: pip install mujoco") from error
    return mujoco


def read_spec(path: Path, root: Path) -> Any:
    """The `mujoco.MjSpec` of an MJCF file all of whose references lie in the folder `root`; raises `CaseError`."""
    referenced_files(path, root)
    try:
        return import_mujoco().MjSpec.from_file(str(path))
    except ValueError as error:
        raise _broken(path, error) from error


def compile_spec(spec: Any, path: Path) -> Any:
    """The `mujoco.MjModel` of a specification; raises `CaseError` with MuJoCo's reason in one line."""
    try:
        return spec.compile()
    except ValueError as error:
        raise _broken(path, error) from error


def referenced_files(path: Path, root: Path) -> list[Path]:
    """Every file that an MJCF file includes or loads, itself first; raises `CaseError` for one outside `root`.

    A reference is looked for beside the main file, beside the file that makes it and in the folder that the compiler
    names for its kind; each of these places has to be inside.
    """
    root, found, waiting = root.resolve(), [], [path]
    folders: dict[str, str] = {}
    while waiting:
        current = waiting.pop(0)
        found.append(current)
        tree = _parse(current)
        for compiler in tree.iter("compiler"):
            shared = {key: compiler.attrib["assetdir"] for key in FOLDERS.values() if "assetdir" in compiler.attrib}
            folders |= shared | {key: compiler.attrib[key] for key in FOLDERS.values() if key in compiler.attrib}
        for element in tree.iter():
            for name, value in element.attrib.items():
                if not (name.startswith("file") and value):
                    continue
                folder = folders.get(FOLDERS.get(element.tag, ""), "")
                places = [base / folder / value for base in (path.parent, current.parent)]
                places.append(path.parent / value)
                for place in places:
                    if not place.resolve().is_relative_to(root):
                        what = f"<{element.tag}> refers to {quote(value)}, outside of the case folder"
                        raise CaseError(current.name, what, "copy the file into the folder and refer to it there")
                there = next((place for place in places if place.is_file()), None)
                if there is None or there in found or there in waiting:
                    continue
                nested = element.tag in ("include", "model") and there.suffix.lower() in (".xml", ".mjcf")
                (waiting if nested else found).append(there)
    return found


def _parse(path: Path) -> ElementTree.Element:
    try:
        text = path.read_bytes()
    except OSError as error:
        raise CaseError(path.name, f"cannot be read ({error.strerror})", "check 'model' in case.toml") from error
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise CaseError(path.name, "has a document type, which MJCF has not", "remove it")
    try:
        tree = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise CaseError(path.name, f"is not XML ({error})", "correct it there") from error
    if tree.tag not in ("mujoco", "mujocoinclude"):
        raise CaseError(
            path.name, f"is not MJCF, its outermost element is <{quote(tree.tag)[1:-1]}>", "save it as MJCF"
        )
    return tree


def _broken(path: Path, error: ValueError) -> CaseError:
    reason = "".join(c for c in " ".join(str(error).split()) if c.isprintable())
    return CaseError(path.name, f"does not compile ({reason})", "correct it until MuJoCo loads it")
