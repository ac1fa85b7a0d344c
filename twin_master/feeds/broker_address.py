"""The address of an MQTT broker from which observations come."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from ssl import create_default_context
from urllib.parse import unquote, urlsplit

from twin_master.errors import MissionInputError

PASSWORD_VARIABLE = "UAV_TWIN_MQTT_PASSWORD"
"""The environment variable with the password of the twin."""
_SPARKPLUG = "spBv1.0"
"""The first level of topics of Sparkplug B, whose payloads are protocol buffers.

A metric has its name in the message of birth alone, on a topic of its own; later messages have its
alias.
"""
_PORT = 1883
_PORT_WITH_TLS = 8883


@dataclass(frozen=True)
class Broker:
    """A broker and the topic of the observations.

    Decisions are published on `TOPIC/decision`, and the state of the twin on `TOPIC/heartbeat`.

    Attributes
    ----------
    host : str
        The host of the broker.
    port : int
        The port of the broker.
    topic : str
        The topic of the observations.
    user : str or None
        The user name of the twin. Its password is in the environment, `UAV_TWIN_MQTT_PASSWORD`.
    tls : bool
        Whether the connection is encrypted (`mqtts://`), with the certificate of the broker.
    authority : Path or None
        The file with the certificate of the authority, if the operating system does not have it.
    """

    host: str
    port: int
    topic: str
    user: str | None = None
    tls: bool = False
    authority: Path | None = None


def is_broker(observations: str) -> bool:
    """Return whether observations come from a broker, and not from a file."""
    return observations.startswith(("mqtt://", "mqtts://"))


def parse_broker(
    address: str, authority: Path | None = None, *, has_many_assets: bool = False
) -> Broker:
    """Return the broker at an address.

    Parameters
    ----------
    address : str
        `mqtt://[USER@]HOST[:PORT]/TOPIC`, or `mqtts://` with TLS.
    authority : Path, optional
        The file with the certificate of the authority.
    has_many_assets : bool
        Whether the topic covers many assets. Such a topic ends with `/+`, which stands for the name
        of an asset.

    Raises
    ------
    MissionInputError
        If paho-mqtt is not installed, if the address has another form or contains a password, if
        its topic does not fit the number of assets, or if the file holds no certificate.
    """
    if find_spec("paho") is None:
        raise MissionInputError(
            "observations over MQTT need paho-mqtt: pip install 'uav-twin[mqtt]'."
        )
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError:
        raise _address_error(address) from None
    topic = unquote(parts.path.lstrip("/"))
    if not parts.hostname or not topic:
        raise _address_error(address)
    if parts.password is not None:
        raise MissionInputError(
            "every user of this machine sees a password in an address: put it into "
            f"{PASSWORD_VARIABLE}."
        )
    if topic.split("/")[0] == _SPARKPLUG:
        raise MissionInputError(
            f"{address}: {_SPARKPLUG} is a topic of Sparkplug B, whose messages are not text and "
            "name their metrics on other topics: let a program that knows Sparkplug, such as "
            "Node-RED, publish the values as JSON on a topic of their own."
        )
    has_wildcard = "#" in address or "+" in topic
    ends_with_wildcard = topic.endswith("/+") and "+" not in topic[:-1] and "#" not in address
    if has_many_assets and not ends_with_wildcard:
        raise MissionInputError(f"{address}: a topic of many assets is expected, such as wings/+.")
    if has_wildcard and not has_many_assets:
        raise MissionInputError(
            f"{address}: a topic of one asset is expected, without `#` and `+`."
        )
    tls = parts.scheme == "mqtts"
    if authority is not None:
        if not tls:
            raise MissionInputError(f"the certificate {authority} needs an address with mqtts://.")
        if not authority.is_file():
            raise MissionInputError(f"there is no file {authority} with a certificate.")
        before = f"{authority} holds no certificate: "
        with MissionInputError.instead_of(OSError, before=before, after="."):
            create_default_context(cafile=authority)
    return Broker(
        host=parts.hostname,
        port=port or (_PORT_WITH_TLS if tls else _PORT),
        topic=topic,
        user=None if parts.username is None else unquote(parts.username),
        tls=tls,
        authority=authority,
    )


def _address_error(address: str) -> MissionInputError:
    """Return the error for an address that is not one of a broker."""
    return MissionInputError(
        f"{address}: `mqtt://[USER@]HOST[:PORT]/TOPIC` is expected, or `mqtts://`."
    )
