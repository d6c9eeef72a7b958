"""Messages on a network as nodes of ROS 2 exchange them, by Cyclone DDS (extra ``ros2``), no ROS.

A topic ``/a`` is ``rt/a`` on the wire, a type ``p/msg/T`` is ``p::msg::dds_::T_``. Cyclone checks
what is sent and received against these types; their bytes are made and read by rosbags.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree

from recon.core.errors import FormatError, SettingsError, SourceError, require
from recon.core.text import counted
from recon.io.ros.messages import Message, encode, message_types

DOMAIN: Final = "ROS_DOMAIN_ID"
_RANGE: Final = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_CYCLONE: Final = "CYCLONEDDS_URI"
_MOST_DOMAIN: Final = 232  # beyond which DDS has no ports
_PREFIX: Final = "rt"
DEPTH: Final = 10  # messages that may wait to be taken, or sent again to who missed one
_WAKE_S: Final = 0.1
# As rmw_cyclonedds has it for nodes of one machine; without multicast, others are found by port.
_LOOPBACK: Final = """<CycloneDDS><Domain><General>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast><MaxMessageSize>65500B</MaxMessageSize></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
_JOINING: Final = threading.Lock()  # a domain begins once
_BASE: Final = dict.fromkeys(("byte", "octet", "char"), "uint8") | {
    "string": "str",
    "wstring": "str",
}


class NetworkTopic(NamedTuple):
    """A topic that somebody publishes."""

    name: str
    kind: str  # such as sensor_msgs/msg/Image
    reliable: bool = False  # whether all who publish it send again what was lost
    kept: bool = False  # whether all of them give the last messages to who subscribes late
    publishers: int = 0


@dataclass(frozen=True, eq=False)
class Received:
    """A message that arrived, by `time.monotonic`; ``content`` is its CDR."""

    topic: str
    kind: str
    content: bytes
    arrived_s: float

    def parse(self) -> Any:
        """Return the message, as rosbags reads it; one that cannot be read is a `FormatError`."""
        try:
            return message_types().deserialize_cdr(self.content, self.kind)
        except Exception as error:
            got = f"{counted(len(self.content), 'byte')}: {error or type(error).__name__}"
            raise FormatError("message cannot be read", where=self.topic, got=got) from error


def domain_of(environment: Mapping[str, str] = os.environ) -> int:
    """Return the domain of ROS 2 that the environment names; 0 = it names none."""
    text = environment.get(DOMAIN, "").strip() or "0"
    if not (text.isascii() and text.isdecimal() and int(text) <= _MOST_DOMAIN):
        expected = f"a number from 0 to {_MOST_DOMAIN}"
        raise SettingsError("not a domain of ROS 2", where=DOMAIN, got=text, expected=expected)
    return int(text)


def configuration_of(environment: Mapping[str, str] = os.environ) -> tuple[str | None, str]:
    """Return the configuration of Cyclone, None = its own; and who is talked to, in words.

    Nobody outside this machine, unless the environment asks for it as ROS 2 does, or has a
    configuration of Cyclone.
    """
    if environment.get(_CYCLONE):
        _check_configuration(environment[_CYCLONE])
        return None, f"the networks that {_CYCLONE} names"
    asked = environment.get(_RANGE, "").strip().upper() or "LOCALHOST"
    if asked == "SUBNET":
        return None, f"the local network, as {_RANGE} says"
    if asked != "LOCALHOST":
        expected = f"LOCALHOST or SUBNET; {_CYCLONE} can name peers and interfaces"
        raise SettingsError("not a range of discovery", where=_RANGE, got=asked, expected=expected)
    return _LOOPBACK, f"this machine alone ({_RANGE}=SUBNET for the local network)"


def _check_configuration(text: str) -> None:
    """Refuse what Cyclone would pass over, to talk to the whole network then."""
    parts = [text] if text.lstrip().startswith("<") else text.split(",")
    try:
        for part in (one.strip().removeprefix("file://") for one in parts):
            # Of the user's own environment, which can do worse than long entities.
            ElementTree.fromstring(part if part.startswith("<") else Path(part).read_bytes())  # noqa: S314
    except (OSError, ElementTree.ParseError) as error:
        what, expected = "not a configuration", "XML, or file:// and the path of some"
        raise SettingsError(what, where=_CYCLONE, got=error, expected=expected) from error


class Network:
    """A participant in a domain of ROS 2, until it is closed."""

    def __init__(self, domain: int | None = None) -> None:
        names = ("domain", "core", "builtin", "topic", "pub", "sub", "util")
        self._dds = {name: require(f"cyclonedds.{name}", extra="ros2") for name in names}
        self.domain = domain_of() if domain is None else domain
        own, self.reach = configuration_of()
        before = _sockets()
        with _JOINING, self._our_errors("the network cannot be joined"):
            configuration = own or os.environ.get(_CYCLONE, "")
            self._domain = _domain(self.domain, configuration)
            self._participant = self._dds["domain"].DomainParticipant(self.domain)
            kinds = self._dds["builtin"].BuiltinTopicDcpsPublication
            self._endpoints = self._dds["builtin"].BuiltinDataReader(self._participant, kinds)
        if own is not None:
            _keep_inside(_sockets() - before)
        self._readers: list[_Reader] = []
        self._writers: dict[str, Any] = {}
        self._writing, self._reading = threading.Lock(), threading.Lock()
        self._closed = False
        self._waiting = self._dds["core"].WaitSet(self._participant)

    def topics(self) -> dict[str, NetworkTopic]:
        """Return what others publish, as far as it is known by now: a second, or two, after."""
        with self._our_errors("the network cannot be read"):
            found = self._endpoints.read(1000)
        of, topics = self._dds["core"].Policy, dict[str, NetworkTopic]()
        for end in found:
            kind = _kind_of(str(getattr(end, "type_name", "")))
            if kind is None or not end.topic_name.startswith(f"{_PREFIX}/"):
                continue
            if str(end.participant_key) == str(self._participant.guid):
                continue
            name, qos = end.topic_name[len(_PREFIX) :], list(end.qos)
            reliable = any(isinstance(one, of.Reliability.Reliable) for one in qos)
            kept = of.Durability.Volatile not in qos
            if (before := topics.get(name)) is not None:
                reliable, kept = reliable and before.reliable, kept and before.kept
            count = 1 if before is None else before.publishers + 1
            topics[name] = NetworkTopic(name, kind, reliable, kept, count)
        return topics

    def subscribe(self, wanted: NetworkTopic, depth: int = DEPTH) -> None:
        """Take the messages of a topic from now on, as it is offered; ``depth`` may wait."""
        name, kind = wanted.name, wanted.kind
        with self._our_errors(f"{name} cannot be subscribed to"):
            quality = self._quality(wanted.reliable, wanted.kept, depth)
            topic = self._topic(name, kind)
            reader = self._dds["sub"].DataReader(self._participant, topic, quality)
            core = self._dds["core"]
            new = core.ViewState.Any | core.InstanceState.Alive | core.SampleState.NotRead
            condition = core.ReadCondition(reader, new)
            self._waiting.attach(condition)
            self._readers.append(_Reader(name, kind, reader, condition, depth))

    def receive(self, stopped: Callable[[], bool] = lambda: False) -> Iterator[list[Received]]:
        """Yield what arrived, at least ten times a second, if only nothing; until stopped."""
        wait = self._dds["util"].duration(seconds=_WAKE_S)
        while not stopped():
            with self._reading, self._our_errors("the network cannot be read"):
                if self._closed:
                    return
                self._waiting.wait(wait)
                now_s, found = time.monotonic(), list[Received]()
                for one in self._readers:
                    taken = one.reader.take(one.depth, condition=one.condition)
                    contents = (getattr(sample, "content", None) for sample in taken)
                    whole = (bytes(each) for each in contents if isinstance(each, bytes))
                    found += [Received(one.topic, one.kind, each, now_s) for each in whole]
            yield found

    def write(self, topic: str, time_ns: int, message: Message, *, kept: bool = False) -> None:
        """Publish a message; ``kept`` = who subscribes late gets the last one of the topic, too."""
        del time_ns  # of the header; on the wire is the time of sending
        kind, content = message[0], encode(message)
        with self._writing, self._our_errors(f"{topic} cannot be published"):
            if self._closed:
                raise SourceError("the network was left already", where=topic)
            if topic not in self._writers:
                quality = self._quality(True, kept, 1 if kept else DEPTH)
                publish = self._dds["pub"].DataWriter
                self._writers[topic] = publish(self._participant, self._topic(topic, kind), quality)
            fault = self._dds["core"].DDSException
            try:
                self._writers[topic].write(_type_of(kind)(content))
            except fault as error:
                # Who takes nothing for long misses messages; the others go on.
                if error.code != fault.DDS_RETCODE_TIMEOUT:
                    raise

    def close(self) -> None:
        """Leave the network. What is kept is gone then, as with any node of ROS 2."""
        self._closed = True
        with self._reading, self._writing:
            self._waiting = self._endpoints = None
            self._readers.clear()
            self._writers.clear()
            self._participant = self._domain = None

    def _topic(self, name: str, kind: str) -> Any:
        return self._dds["topic"].Topic(self._participant, f"{_PREFIX}{name}", _type_of(kind))

    def _quality(self, reliable: bool, kept: bool, depth: int) -> Any:
        of, core = self._dds["core"].Policy, self._dds["core"]
        block = self._dds["util"].duration(milliseconds=100)
        return core.Qos(
            of.Reliability.Reliable(block) if reliable else of.Reliability.BestEffort,
            of.Durability.TransientLocal if kept else of.Durability.Volatile,
            of.History.KeepLast(depth),
            of.DataRepresentation(use_cdrv0_representation=True),
            # Members have other names in the types of ROS 2 that are sent along.
            of.TypeConsistency.AllowTypeCoercion(ignore_member_names=True),
        )

    @contextmanager
    def _our_errors(self, what: str) -> Iterator[None]:
        try:
            yield
        except self._dds["core"].DDSException as error:
            where, got = f"domain {self.domain}", str(error)
            raise SourceError(what, where=where, got=got, hint=f"see {_CYCLONE}") from error


class _Reader(NamedTuple):
    topic: str
    kind: str
    reader: Any
    condition: Any
    depth: int


def _sockets() -> set[int]:
    """Return the descriptors of the sockets of this process, where the system lists them."""
    folder = Path("/proc/self/fd")
    if not folder.is_dir():
        return set()
    return {int(one.name) for one in folder.iterdir() if "socket:" in _target(one)}


def _target(link: Path) -> str:
    with suppress(OSError):  # closed meanwhile
        return str(link.readlink())
    return ""


def _keep_inside(descriptors: set[int]) -> None:
    """Let sockets hear this machine alone: Cyclone binds them to all interfaces, whatever is set.

    Ref: eclipse-cyclonedds/cyclonedds, issue 2090.
    """
    for descriptor in descriptors:
        with socket.socket(fileno=os.dup(descriptor)) as one:
            try:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")
            except PermissionError as error:
                what, expected = "the network cannot be kept on this machine", "Linux 5.7 or later"
                hint = f"{_RANGE}=SUBNET lets others in"
                raise SourceError(what, got=error, expected=expected, hint=hint) from error


@cache
def _domain(number: int, configuration: str) -> Any:
    """Begin a domain, once in a process, as Cyclone has it; "" = by its defaults."""
    return require("cyclonedds.domain", extra="ros2").Domain(number, configuration or None)


def _kind_of(type_name: str) -> str | None:
    """Return the type of a message by its name on the wire, if we know it."""
    package, _, name = type_name.removesuffix("_").partition("::msg::dds_::")
    kind = f"{package}/msg/{name}"
    return kind if kind in message_types().fielddefs else None


@cache
def _type_of(kind: str) -> Any:
    """Return a type of Cyclone for messages of ROS, whose bytes stay as they are."""
    made = _described(kind)

    def begin(self: Any, content: bytes) -> None:
        self.content = content

    made.__init__ = begin
    made.serialize = lambda self, *_, **__: self.content
    made.deserialize = classmethod(lambda of, data, *_, **__: of(data))
    return made


@cache
def _described(kind: str) -> Any:
    """Return the description of a message, which Cyclone checks bytes against."""
    package, name = kind.split("/msg/")
    fields = {field: _field(of) for field, of in message_types().fielddefs[kind][1]}
    idl = require("cyclonedds.idl", extra="ros2")
    return idl.make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", fields)


def _field(definition: Any) -> Any:
    types = require("cyclonedds.idl.types", extra="ros2")
    node, of = definition
    name = node.name
    if name == "NAME":
        return _described(of)
    if name == "BASE":
        base = _BASE.get(of[0], of[0])
        return {"str": str, "bool": bool}.get(base) or getattr(types, base)
    inner = _field(of[0])
    return types.array[inner, of[1]] if name == "ARRAY" else types.sequence[inner]
