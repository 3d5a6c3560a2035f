"""Reading a user's MJCF: only from its own folder, and with one line where it does not compile."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from bayessim_jax.recordings.wording import CaseError, quote

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["compile_spec", "import_mujoco", "included_files", "read_spec", "referenced_files"]

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

    A reference is taken from beside the main file and from beside the file that makes it, in the folder that the
    compiler names for its kind; both have to be inside. Files that are not there are left to MuJoCo to miss.
    """
    found: dict[Path, Path] = {}
    models = [path]
    while models:
        parts = _parts(models[0], root)
        for place in _loaded(models.pop(0), parts, root):
            nested = place.suffix.lower() in (".xml", ".mjcf")
            if place.resolve() not in found and nested:
                models.append(place)
            found.setdefault(place.resolve(), place)
        found = {file.resolve(): file for file in parts} | found
    return list(found.values())


def included_files(path: Path, root: Path) -> list[Path]:
    """An MJCF file and those that it includes, which are one model with it; raises as `referenced_files` does."""
    return list(_parts(path, root))


def _parts(path: Path, root: Path) -> dict[Path, ElementTree.Element]:
    """A model file and everything that it includes, parsed."""
    found, seen, waiting = {}, set(), [path]
    while waiting:
        file = waiting.pop(0)
        if file.resolve() in seen:
            continue
        seen.add(file.resolve())
        found[file] = _parse(file)
        for element in found[file].iter("include"):
            places = _places(element, element.attrib.get("file", ""), "", (path, file), root)
            waiting += [place for place in places if place.is_file()][:1]
    return found


def _loaded(path: Path, parts: dict[Path, ElementTree.Element], root: Path) -> Iterator[Path]:
    """What a model loads besides its parts: meshes, textures, other models."""
    folders: dict[str, str] = {}
    for file, tree in parts.items():
        for compiler in tree.iter("compiler"):
            shared = dict.fromkeys(FOLDERS.values(), compiler.attrib.get("assetdir"))
            given = shared | {key: compiler.attrib[key] for key in FOLDERS.values() if key in compiler.attrib}
            folders |= {key: value for key, value in given.items() if value}
            for value in folders.values():
                _places(compiler, value, "", (path, file), root)
    for file, tree in parts.items():
        for element in tree.iter():
            folder = folders.get(FOLDERS.get(element.tag, ""), "")
            for name, value in element.attrib.items():
                if name.startswith("file") and value and element.tag != "include":
                    yield from [p for p in _places(element, value, folder, (path, file), root) if p.is_file()][:1]


def _places(element: ElementTree.Element, value: str, folder: str, files: tuple[Path, Path], root: Path) -> list[Path]:
    """Where a reference of a file may point, beside the main file and beside itself; raises `CaseError` outside."""
    places = [file.parent / folder / value for file in files]
    for place in places:
        if not place.resolve().is_relative_to(root.resolve()):
            what = f"<{element.tag}> refers to {quote(value)}, outside of the case folder"
            raise CaseError(files[1].name, what, "copy the file into the folder and refer to it there")
    return places


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
