"""Addresses of registers at a broker.

==============================================  ========================================================
``plant/robot/pos``                             the text of a topic's messages
``plant/robot/state $.axes[0].pos``             a value in the JSON of a topic's messages
``plant/robot/state $``                         the whole JSON, such as a number or an array
``sparkplug Group/Node metric NAME``            a metric of a Sparkplug edge node
``sparkplug Group/Node/Device metric NAME``     a metric of a device of that node
``ADDRESS -> plant/robot/pos/set``              writes are published as text on another topic
``ADDRESS -> plant/robot/set $.pos``            writes are published there as JSON: ``{"pos": 1.5}``
==============================================  ========================================================
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple
from unicodedata import category

from shmio.connectors.mqtt import json_path
from shmio.connectors.mqtt.json_path import Steps

NAMESPACE: Final = "spBv1.0"
MAX_TOPIC: Final = 1000
EXAMPLES: Final = (
    "write TOPIC, such as plant/robot/pos; TOPIC $.PATH for JSON; or sparkplug GROUP/NODE/DEVICE metric NAME"
)
_JSON: Final = re.compile(r"(.+?) (\$(?:[.\[].*)?)")
_SPARKPLUG: Final = re.compile(r"sparkplug (.+?) metric (.+)")
_ARROW: Final = " -> "


class Place(NamedTuple):
    """The place of a value in the messages of a topic.

    ``steps`` is the path of the value in JSON. If it is None, the payload is the value as text.
    """

    topic: str
    steps: Steps | None


class Metric(NamedTuple):
    """A metric of Sparkplug B.

    ``device`` is empty if the metric belongs to the edge node itself.
    """

    group: str
    node: str
    device: str
    name: str

    @property
    def owner(self) -> str:
        """The node or device that has the metric: ``GROUP/NODE`` or ``GROUP/NODE/DEVICE``."""
        return "/".join(filter(None, self[:3]))


class Address(NamedTuple):
    """The place where a register is read (``source``), and where its writes are published (``target``).

    If ``target`` is None, writes are published on ``source``.
    """

    source: Place | Metric
    target: Place | None


def parse(text: str) -> Address:
    """Parse the address of a register.

    Raises:
        ValueError: The address is wrong; the message says what is wrong.

    """
    text = text.strip()
    if not text:
        raise ValueError(f"the key `address` is missing; {EXAMPLES}")
    before, arrow, after = f" {text} ".rpartition(_ARROW)
    if text.startswith("sparkplug "):
        return Address(_metric(text), None)
    if not arrow:
        return Address(place(text), None)
    return Address(place(before), place(after))


def place(text: str) -> Place:
    """Parse a topic, with a path in its JSON if the text has one.

    Raises:
        ValueError: The text is wrong; the message says what is wrong.

    """
    text = text.strip()
    found = _JSON.fullmatch(text)
    if found is None:
        return Place(_topic(text), None)
    return Place(_topic(found[1].strip()), json_path.parse(found[2]))


def _topic(text: str) -> str:
    if not text:
        raise ValueError(f"the topic is missing; {EXAMPLES}")
    if set("+#") & set(text):
        raise ValueError(f"{text!r}: a register has exactly one topic: + and # are not allowed in its address")
    if len(text) > MAX_TOPIC or any(_is_no_text(one) for one in text):
        raise ValueError(
            f"{text[:60]!r}: a topic has at most {MAX_TOPIC} characters, and no control or invalid characters"
        )
    if text.startswith("$share/"):
        raise ValueError(f"{text!r}: a shared subscription would get only some of the messages; leave out $share/NAME/")
    if text.split("/", 1)[0] == NAMESPACE:
        raise ValueError(f"{text!r}: this is a topic of Sparkplug; write sparkplug GROUP/NODE/DEVICE metric NAME")
    return text


def _metric(text: str) -> Metric:
    found = _SPARKPLUG.fullmatch(text)
    if found is None:
        raise ValueError(
            f"{text!r}: write sparkplug GROUP/NODE metric NAME, or sparkplug GROUP/NODE/DEVICE metric NAME"
        )
    levels = found[1].strip().split("/")
    bad = any(not level or set("+#") & set(level) or any(map(_is_no_text, level)) for level in levels)
    if bad or not 2 <= len(levels) <= 3 or len(found[1]) > MAX_TOPIC:
        raise ValueError(f"{found[1][:60]!r}: write GROUP/NODE or GROUP/NODE/DEVICE, without + and #")
    return Metric(levels[0], levels[1], levels[2] if len(levels) == 3 else "", found[2].strip())


def _is_no_text(one: str) -> bool:
    """Return whether brokers refuse topics with this character (MQTT 5.0, 1.5.4)."""
    return category(one) in ("Cc", "Cs") or 0xFDD0 <= ord(one) <= 0xFDEF or ord(one) & 0xFFFE == 0xFFFE
