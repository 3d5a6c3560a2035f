"""MCAP: JSON messages and ROS 2 messages (CDR), merged over the times of the topics that are used."""

from __future__ import annotations

import contextlib
import io
import json
from array import array
from typing import TYPE_CHECKING, Any

import numpy as np

from bayessim_jax.recordings.readers.table import Table, reason
from bayessim_jax.recordings.wording import CaseError, quote

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

__all__ = ["read"]

KINDS = ("joint/", "actuator/", "sensor/")
JOINT_STATE = {"position": "qpos", "velocity": "qvel", "effort": "effort"}


def read(path: Path, wanted: Collection[str] | None) -> Table:
    """Read an MCAP file.

    A joint state (`name`, `position`, `velocity`, `effort`) gives `joint/<name>/qpos`, `…/qvel` and `…/effort`. A key
    that begins with joint/, actuator/ or sensor/ is a column; any other number is one under `<topic>/<key>`, for
    `column` in case.toml to refer to. A message's time is its header's stamp, a number under `time`, or when it was
    logged. Rows stand at every time of a column that is wanted; what was not measured then is NaN.
    """
    series: dict[str, tuple[array, array]] = {}
    names: dict[str, None] = {}
    unread: dict[str, None] = {}
    try:
        for topic, logged, content, encoding in _messages(path):
            if content is None:
                unread[f"{topic} ({encoding})"] = None
                continue
            time = _time(content, logged)
            for name, value in _columns(content, topic):
                names[name] = None
                if wanted is None or name in wanted:
                    times, values = series.setdefault(name, (array("d"), array("d")))
                    if times and not time > times[-1]:
                        what = "occurs twice" if time == times[-1] else "runs backwards"
                        where = f"in message {len(times) + 1} of {quote(topic)}, at {time:.9g} s"
                        raise CaseError(path.name, f"time {what} {where}", "keep one message for each time, in order")
                    times.append(time)
                    values.append(value)
    except (CaseError, OSError, ImportError):
        raise
    except Exception as error:  # decompressors and decoders have errors of their own kinds
        raise CaseError(path.name, f"is damaged or not MCAP ({reason(error)})", "record or convert it again") from error
    if unread and not series:
        known = ", ".join(quote(name) for name in list(unread)[:3])
        raise CaseError(path.name, f"no message is JSON or ROS 2 CDR, only {known}", "convert the recording")
    return _merge(("time", *names, *unread), series)


def _messages(path: Path) -> Iterator[tuple[str, int, Any, str]]:
    """Topic, time of logging in ns, content (None where it cannot be decoded) and encoding of every message."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    factory, decoders = DecoderFactory(), {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            content = None
            if channel.message_encoding == "json":
                content = json.loads(message.data)
            else:
                if channel.id not in decoders:
                    with contextlib.redirect_stderr(io.StringIO()):  # the parser of definitions prints what it refuses
                        decoders[channel.id] = factory.decoder_for(channel.message_encoding, schema)
                if decode := decoders[channel.id]:
                    content = decode(message.data)
            yield channel.topic, message.log_time, content, channel.message_encoding


def _merge(names: tuple[str, ...], series: dict[str, tuple[array, array]]) -> Table:
    stamps = [np.frombuffer(times) for times, _ in series.values()]
    time = np.unique(np.concatenate(stamps)) if stamps else np.empty(0)
    columns = {"time": time}
    for name, (times, values) in series.items():
        column = np.full(len(time), np.nan)
        column[np.searchsorted(time, np.frombuffer(times))] = np.frombuffer(values)
        columns[name] = column
    return Table(names, columns, asynchronous=any(len(s) < len(time) for s in stamps))


def _time(content: Any, logged: int) -> float:
    stamp = _get(_get(content, "header"), "stamp")
    seconds, nanoseconds = _get(stamp, "sec"), _get(stamp, "nanosec")
    if isinstance(seconds, int) and isinstance(nanoseconds, int) and (seconds or nanoseconds):
        return seconds + nanoseconds * 1e-9
    given = content.get("time") if isinstance(content, dict) else None
    return float(given) if isinstance(given, (int, float)) else logged * 1e-9


def _columns(content: Any, topic: str) -> Iterator[tuple[str, float]]:
    joints = _get(content, "name")
    if isinstance(joints, (list, tuple)) and isinstance(_get(content, "position"), (list, tuple, array)):
        for part, field in JOINT_STATE.items():
            for joint, value in zip(joints, _get(content, part) or (), strict=False):
                yield f"joint/{joint}/{field}", float(value)
        return
    for key, value in _numbers(content, ""):
        if key != "time" and not key.startswith("header/"):
            yield key if key.startswith(KINDS) else f"{topic}/{key}", value


def _numbers(content: Any, prefix: str) -> Iterator[tuple[str, float]]:
    """Every number in a message with the path to it."""
    if isinstance(content, (bool, int, float)):
        yield prefix, float(content)
    elif isinstance(content, dict):
        for key, value in content.items():
            yield from _numbers(value, f"{prefix}/{key}" if prefix else str(key))
    elif isinstance(content, (list, tuple, array)):
        for i, value in enumerate(content):
            yield from _numbers(value, f"{prefix}/{i}")
    elif hasattr(content, "__slots__"):
        for key in content.__slots__:
            if not key.startswith("_"):
                yield from _numbers(getattr(content, key, None), f"{prefix}/{key}" if prefix else key)


def _get(content: Any, key: str) -> Any:
    return content.get(key) if isinstance(content, dict) else getattr(content, key, None)
