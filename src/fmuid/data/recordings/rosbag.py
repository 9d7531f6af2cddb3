"""ROS bags (``.bag``, ``.db3``) and MCAP files (``.mcap``); only this module imports rosbags and mcap.

A signal is a number in the messages of a topic, such as ``/joint_states.position.elbow``. Array elements are named
by the message's ``name`` list if it has one, else by number. Times come from the messages' headers, else from the
log, and start at the first message of the file; jitter is kept.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fmuid.core.errors import MeasurementsError
from fmuid.data.recordings.recording import Recording, Vector, by_time_base, left_out

rosbags: Any
mcap: Any
try:
    import rosbags
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
except ImportError:
    rosbags = None
try:
    import mcap
    from mcap.reader import make_reader
except ImportError:
    mcap = None

_LONGEST = 64  # largest number of array elements that become signals
_SKIPPED = ("header", "__msgtype__")


@dataclass(slots=True)
class _Topic:
    times: list[float] = field(default_factory=list)
    rows: list[dict[str, float]] = field(default_factory=list)


def read(path: Path) -> Recording:
    """Read a bag or an MCAP file; see `fmuid.data.recordings.read_recording`.

    Each topic has its own time base.
    """
    if rosbags is None or mcap is None:
        raise MeasurementsError("needs rosbags and mcap", where=path, fix="pip install 'fmuid[ros]'")
    others: list[str] = []
    topics: dict[str, _Topic] = {}
    try:
        messages = _of_mcap(path, others) if path.suffix.casefold() == ".mcap" else _of_bag(path, others)
        for topic, stamp, message in messages:
            of_topic = topics.setdefault(topic, _Topic())
            of_topic.times.append(_header_time(message, stamp))
            of_topic.rows.append(dict(_numbers(message)))
    except Exception as error:  # the parsers may raise anything on damaged files
        what = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise MeasurementsError(f"cannot be read ({what})", where=path, fix="record it again") from None
    silent = [topic for topic, of_topic in topics.items() if not any(of_topic.rows)]
    notes = left_out([*others, *silent], "not numeric")
    return by_time_base(_vectors({t: f for t, f in topics.items() if any(f.rows)}), path, notes)


def _of_bag(path: Path, others: list[str]) -> Iterator[tuple[str, float, Any]]:
    # A ROS 2 bag is a folder; a .db3 in it stands for all of it.
    place = path.parent if path.suffix.casefold() == ".db3" else path
    with AnyReader([place], default_typestore=get_typestore(Stores.LATEST)) as reader:
        for connection, stamp, raw in reader.messages():
            try:
                message = reader.deserialize(raw, connection.msgtype)
            except KeyError:
                others.append(connection.topic) if connection.topic not in others else None
                continue
            yield connection.topic, 1e-9 * stamp, message


def _of_mcap(path: Path, others: list[str]) -> Iterator[tuple[str, float, Any]]:
    store = get_typestore(Stores.LATEST)
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            stamp = 1e-9 * message.log_time
            if channel.message_encoding == "json":
                yield channel.topic, stamp, json.loads(message.data)
            elif channel.message_encoding == "cdr" and schema is not None:
                if schema.name not in store.fielddefs:
                    store.register(get_types_from_msg(schema.data.decode(), schema.name))
                yield channel.topic, stamp, store.deserialize_cdr(message.data, schema.name)
            elif channel.topic not in others:
                others.append(channel.topic)


def _fields(message: Any) -> Mapping[str, Any] | None:
    if isinstance(message, Mapping):
        return message
    names = getattr(message, "__dataclass_fields__", None)
    return None if names is None else {name: getattr(message, name) for name in names}


def _header_time(message: Any, logged: float) -> float:
    stamp = _fields((_fields((_fields(message) or {}).get("header")) or {}).get("stamp")) or {}
    nanoseconds = stamp.get("nanosec", stamp.get("nsec"))
    if "sec" in stamp and nanoseconds is not None and (stamp["sec"] or nanoseconds):
        return float(stamp["sec"]) + 1e-9 * float(nanoseconds)
    return logged


def _numbers(message: Any, prefix: str = "") -> Iterator[tuple[str, float]]:
    fields = _fields(message) or {}
    names = fields.get("name")
    labels = [str(n) for n in names] if isinstance(names, list | tuple) else []
    for key, value in fields.items():
        name = f"{prefix}.{key}" if prefix else key
        if key in _SKIPPED:
            continue
        if isinstance(value, bool | int | float | np.number):
            yield name, float(value)
        elif isinstance(value, np.ndarray | list | tuple):
            yield from _elements(name, value, labels)
        elif _fields(value) is not None:
            yield from _numbers(value, name)


def _elements(
    name: str, values: Sequence[Any] | np.ndarray[Any, Any], labels: list[str]
) -> Iterator[tuple[str, float]]:
    if len(values) > _LONGEST:
        return
    suffixes = labels if len(labels) == len(values) else [str(i) for i in range(len(values))]
    for label, value in zip(suffixes, values, strict=True):
        if isinstance(value, bool | int | float | np.number):
            yield f"{name}.{label}", float(value)
        elif _fields(value) is not None:
            yield from _numbers(value, f"{name}.{label}")


def _vectors(topics: Mapping[str, _Topic]) -> Iterable[Vector]:
    begin = min((min(t.times) for t in topics.values()), default=0.0)
    for topic, messages in topics.items():
        order = np.argsort(messages.times, kind="stable")
        time = np.array(messages.times)[order] - begin
        for name in dict.fromkeys(n for row in messages.rows for n in row):
            values = np.array([row.get(name, np.nan) for row in messages.rows])[order]
            yield Vector(f"{topic}.{name}", time, values)
