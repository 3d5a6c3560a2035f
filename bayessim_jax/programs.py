"""Programs that are traced once for all processes, not once in each.

JAX's compilation cache keeps what XLA made of a program; to find it there, every process traces and lowers the program
again, which for a robot in a loop over time steps takes seconds of Python. `trace_once` and `compile_once` keep what
tracing led to, as StableHLO of `jax.export` beside the structure of what is returned, under a name that is made of
everything the trace depends on: the package's own code, the versions of what it stands on, static arguments, and the
structure and shapes of the others. What has no such name, a function from elsewhere for instance, is traced as ever.
Nothing is kept until `keep_traces_in` says where; nothing in these files is run but by XLA, the only names read from
them are those of the package's own containers, and a file that cannot be read is made again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import inspect
import json
import struct
import sys
import tempfile
import types
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from jax import export
from jax.core import Tracer
from jax.tree_util import PyTreeDef, default_registry

__all__ = ["Unnamed", "compile_once", "keep_traces_in", "name_of", "trace_once"]

PACKAGE = __package__ or "bayessim_jax"
STANDS_ON = ("jax", "jaxlib", "flax", "optax", "distrax", "mujoco", "numpy")
OPTIONAL = ("brax", "mujoco-mjx")
"""Engines that programs may be traced through without a word of them in a name."""
CONTAINERS = {f"builtins.{kind.__name__}": kind for kind in (tuple, list, dict, type(None))}
SETTINGS = (
    "enable_x64",
    "default_matmul_precision",
    "default_prng_impl",
    "numpy_dtype_promotion",
    "threefry_partitionable",
)
"""Of JAX's settings, those that a trace depends on."""

_folder: Path | None = None


class Unnamed(Exception):  # noqa: N818
    """A value that another process would not recognize."""


def keep_traces_in(folder: Path | None) -> None:
    """Where programs are kept from now on; None for nowhere."""
    global _folder
    _folder = folder


def trace_once(
    function: Callable[..., Any] | None = None,
    *,
    static_argnames: str | Sequence[str] = (),
    compiler_options: Mapping[str, Any] | None = None,
    to_numpy: bool = False,
) -> Any:
    """`jax.jit` of a function whose trace is kept where `keep_traces_in` says.

    With `to_numpy` it returns NumPy's arrays, for what is put together on the host.
    """
    if function is None:
        return functools.partial(
            trace_once, static_argnames=static_argnames, compiler_options=compiler_options, to_numpy=to_numpy
        )
    statics = {static_argnames} if isinstance(static_argnames, str) else set(static_argnames)
    options: Any = dict(compiler_options) if compiler_options else None
    traced = jax.jit(function, static_argnames=tuple(statics), compiler_options=options)
    names = list(inspect.signature(function).parameters)
    made: dict[Any, Any] = {}

    def give(returned: Any, tied: bool) -> Any:
        if to_numpy:
            return jax.tree.map(np.asarray, returned)
        return jax.tree.map(_untie, returned) if tied and jax.default_backend() == "cpu" else returned

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if _folder is None:
            return give(traced(*args, **kwargs), tied=False)
        given = dict(zip(names, args, strict=False)) | kwargs
        fixed = {name: given.pop(name) for name in names if name in statics and name in given}
        leaves, structure = jax.tree.flatten(given)
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return traced(*args, **kwargs)
        key = _folder, tuple(fixed.values()), structure, tuple(map(_kind, leaves))
        if key not in made:
            applied = lambda given: function(**given, **fixed)  # noqa: E731
            made[key] = _find(_folder, function, applied, fixed, leaves, structure, options)
        if made[key] is None:
            return give(traced(*args, **kwargs), tied=False)
        program, returned = made[key]
        return give(jax.tree.unflatten(returned, program(*leaves)), tied=True)

    return call


def _kind(x: Any) -> tuple[Any, ...]:
    """What of an argument decides which program it belongs to."""
    if isinstance(x, np.ndarray):
        return x.shape, x.dtype, False
    if isinstance(x, jax.Array):
        return x.shape, x.dtype, x.weak_type
    return np.shape(x), jax.dtypes.result_type(x), _is_weak(x)


def compile_once(
    function: Callable[..., Any], *args: Any, compiler_options: Mapping[str, Any] | None = None
) -> Callable[..., Any]:
    """The compiled program of a function of pytrees for arguments like these, its trace kept as by `trace_once`.

    Arguments may be shapes in place of arrays.
    """
    options: Any = dict(compiler_options) if compiler_options else None
    leaves, structure = jax.tree.flatten(args)
    applied = lambda given: function(*given)  # noqa: E731
    found = _find(_folder, function, applied, (), leaves, structure, options) if _folder is not None else None
    if found is None:
        return jax.jit(function, compiler_options=options).lower(*args).compile()
    program, returned = found[0].lower(*leaves).compile(), found[1]
    return lambda *args: jax.tree.unflatten(returned, program(*jax.tree.leaves(args)))


def _find(
    folder: Path,
    function: Callable[..., Any],
    applied: Callable[[Any], Any],
    fixed: Any,
    leaves: Sequence[Any],
    structure: Any,
    options: Any,
) -> tuple[Any, Any] | None:
    """The program of leaves and the structure of what it returns, from the disk, or traced and put there.

    `applied` is the function of its arguments as `structure` holds them, given what is `fixed`. None where it has no
    name or cannot be kept.
    """
    kinds = tuple((np.shape(x), _dtype(x), _is_weak(x)) for x in leaves)
    backend, settings = jax.default_backend(), [getattr(jax.config, f"jax_{name}") for name in SETTINGS]
    try:
        path = folder / name_of((_standing(), backend, settings, function, fixed, structure, kinds))
    except Unnamed:
        return None
    kept = _read(path, structure)
    if kept is None:
        found: list[Any] = []

        def flat(*leaves: Any) -> Any:
            returned = applied(jax.tree.unflatten(structure, leaves))
            found[:] = [jax.tree.structure(returned)]
            return jax.tree.leaves(returned)

        try:
            exported = export.export(jax.jit(flat))(*leaves)
            head = json.dumps(_describe(found[0], structure)).encode()
            content = struct.pack("<Q", len(head)) + head + bytes(exported.serialize())
        except (NotImplementedError, ValueError, Unnamed):
            return None  # a call into Python, which no file can hold, or a container of others
        _write(path, content)
        kept = exported, found[0]
    exported, returned = kept

    def run(*leaves: Any) -> Any:
        return exported.call(*leaves)

    run.__name__ = function.__name__
    return jax.jit(run, compiler_options=options), returned


def _describe(structure: Any, given: Any) -> Any:
    """A structure as JSON: `*` for a leaf, the number of the same part of `given`, or type, data and parts."""
    node = structure.node_data()
    if node is None:
        return "*"
    alike = [k for k, part in enumerate(given.children()) if _is_same(part, structure)]
    if alike:
        return alike[0]
    kind, data = node
    return [_place(kind).decode().rstrip(";"), _as_json(data), [_describe(c, given) for c in structure.children()]]


def _is_same(one: Any, other: Any) -> bool:
    """Whether two structures have the same types; JAX takes dataclasses with as many fields for equal."""
    parts = one.children(), other.children()
    alike = one.node_data() == other.node_data() and len(parts[0]) == len(parts[1])
    return alike and all(map(_is_same, *parts))


def _as_json(data: Any) -> Any:
    """Static data of words and numbers; tuples are lists in a dictionary."""
    if isinstance(data, tuple):
        return {"tuple": [_as_json(each) for each in data]}
    if isinstance(data, list):
        return [_as_json(each) for each in data]
    if data is None or isinstance(data, (bool, int, float, str)):
        return data
    raise Unnamed(repr(data))


def _rebuild(told: Any, given: Any) -> Any:
    """The structure that `_describe` told."""
    if isinstance(told, int):
        return given.children()[told]
    if told == "*":
        return jax.tree.structure(0)
    name, data, parts = told
    children = [_rebuild(part, given) for part in parts]
    node = _container(name), _from_json(data)
    return PyTreeDef.from_node_data_and_children(default_registry, node, children)


def _from_json(data: Any) -> Any:
    if isinstance(data, dict):
        return tuple(_from_json(each) for each in data["tuple"])
    return [_from_json(each) for each in data] if isinstance(data, list) else data


def _container(name: str) -> type:
    """A class of the package, or one of Python's own containers."""
    if name in CONTAINERS:
        return CONTAINERS[name]
    module, _, last = name.rpartition(".")
    if module.partition(".")[0] != PACKAGE or module not in sys.modules:
        raise ValueError(f"{name} is no container of this package")
    return getattr(sys.modules[module], last)


def _untie(x: Any) -> Any:
    """The same numbers, at no device in particular; on a CPU they stay where they are.

    What a program from the disk returns is tied to its device, and other programs would be compiled once more for it.
    """
    return jax.device_put(np.asarray(x))


def _dtype(x: Any) -> str:
    """What kind of number, or of key, an argument is."""
    return str(x.dtype if hasattr(x, "dtype") else jax.dtypes.result_type(x))


def _is_weak(x: Any) -> bool:
    """Whether a number takes the precision of those that it meets."""
    return bool(getattr(x, "weak_type", isinstance(x, (bool, int, float, complex)) and not isinstance(x, np.generic)))


def _read(path: Path, given: Any) -> Any:
    """What a file holds; None where there is none, or none that can be read."""
    try:
        content = path.read_bytes()
        (size,) = struct.unpack_from("<Q", content)
        told = json.loads(content[8 : 8 + size])
        return export.deserialize(bytearray(content[8 + size :])), _rebuild(told, given)
    except Exception:
        return None


def _write(path: Path, content: bytes) -> None:
    """Put a file there whole or not at all."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as beside:
            (Path(beside) / path.name).write_bytes(content)
            (Path(beside) / path.name).replace(path)
    except OSError:
        return  # a full or a foreign disk costs time, and no result


@functools.cache
def _standing() -> bytes:
    """The package's code, and the versions of what it stands on."""
    found = hashlib.sha256(sys.version.encode())
    for name in STANDS_ON:
        found.update(importlib.metadata.version(name).encode())
    for name in OPTIONAL:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found.update(f"{name} {importlib.metadata.version(name)}".encode())
    root = Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        found.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return found.digest()


def name_of(value: Any) -> str:
    """A name that is the same in every process for equal values, and another one for others; else `Unnamed`."""
    found = hashlib.sha256()
    _feed(found.update, value)
    return found.hexdigest()


def _feed(put: Callable[[bytes], None], x: Any) -> None:
    """Everything that a value is made of, each piece with its kind and length."""
    kind = f"{type(x).__module__}.{type(x).__qualname__}"

    def piece(content: bytes) -> None:
        put(f"{kind}:{len(content)}:".encode() + content)

    if x is None or isinstance(x, (bool, int, str, bytes)):
        piece(x if isinstance(x, bytes) else repr(x).encode())
    elif isinstance(x, float):
        piece(struct.pack("<d", x))
    elif isinstance(x, (np.ndarray, np.generic, np.dtype)) or (isinstance(x, jax.Array) and not isinstance(x, Tracer)):
        piece(_content(x))
    elif isinstance(x, (tuple, list)):
        piece(str(len(x)).encode())
        for each in x:
            _feed(put, each)
    elif isinstance(x, Mapping):
        _feed(put, list(x.items()))
    elif isinstance(x, jax.tree_util.PyTreeDef):
        definition: Any = x
        piece(b"")
        _feed(put, definition.node_data())
        _feed(put, definition.children())
    elif isinstance(x, mujoco.MjModel):
        saved = np.empty(mujoco.mj_sizeModel(x), np.uint8)
        mujoco.mj_saveModel(x, None, saved)
        piece(saved.tobytes())
    elif isinstance(x, type):
        piece(_place(x))
    elif isinstance(x, types.FunctionType):
        if x.__closure__:
            raise Unnamed(repr(x))
        piece(_place(x))
    elif callable(x) and hasattr(x, "__wrapped__"):
        piece(_place(x))  # a function of JAX's own, jitted
    else:
        _feed_object(put, x)


def _feed_object(put: Callable[[bytes], None], x: Any) -> None:
    """An object of the package: what it says makes it equal to others (`_key`), or all that it holds."""
    put(_place(type(x)))
    if hasattr(x, "_key"):
        _feed(put, x._key)
    elif dataclasses.is_dataclass(x):
        _feed(put, [(f.name, getattr(x, f.name)) for f in dataclasses.fields(x)])
    elif hasattr(x, "__dict__"):
        _feed(put, sorted(vars(x).items()))
    else:
        raise Unnamed(repr(x))


def _content(x: Any) -> bytes:
    """Numbers, with their type and shape; of an object type none."""
    if isinstance(x, np.dtype):
        return x.str.encode()
    if isinstance(x, jax.Array) and not jax.numpy.issubdtype(x.dtype, np.number) and x.dtype != bool:
        raise Unnamed(repr(x))
    array = np.asarray(x)
    if array.dtype.hasobject:
        raise Unnamed(repr(x))
    return f"{array.dtype.str}{array.shape}".encode() + array.tobytes()


def _place(x: Any) -> bytes:
    """Where a class or function stands, of the package, of Python, or of what it stands on."""
    module = x.__module__ or ""
    root = module.partition(".")[0]
    if root not in (PACKAGE, "builtins", *STANDS_ON) or "<" in x.__qualname__:
        raise Unnamed(repr(x))
    return f"{module}.{x.__qualname__};".encode()
