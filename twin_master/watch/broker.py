"""The address of an MQTT broker."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from ssl import create_default_context
from urllib.parse import unquote, urlsplit

from twin_master.errors import MissionInputError
from twin_master.sentences import said

PASSWORD_VARIABLE = "UAV_TWIN_MQTT_PASSWORD"


@dataclass(frozen=True)
class Broker:
    """Where observations come from.

    Attributes
    ----------
    host, port, topic : str, int, str
        Of the broker, and of the observations; decisions go to `TOPIC/decision`, how the twin is to
        `TOPIC/heartbeat`.
    user : str or None
        Who the twin is; the password is in the environment, `UAV_TWIN_MQTT_PASSWORD`.
    tls : bool
        `mqtts://`: encrypted, the broker known by its certificate.
    authority : Path or None
        Certificate of the authority, where the system does not know it.
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


def broker_of(address: str, authority: Path | None = None, *, many: bool = False) -> Broker:
    """Return the broker of `mqtt://[USER@]HOST[:PORT]/TOPIC`, or `mqtts://` with TLS.

    Of many assets the topic ends with `/+`, which stands for the name of each.

    Raises
    ------
    MissionInputError
        paho-mqtt is not installed, or it is no such address, has a password in it, or a topic of many assets;
        the authority's file holds no certificate.
    """
    if find_spec("paho") is None:
        raise MissionInputError("observations over MQTT need paho-mqtt: pip install 'uav-twin[mqtt]'.")
    try:
        parts = urlsplit(address)
        port, topic = parts.port, unquote(parts.path.lstrip("/"))
    except ValueError:
        parts, port, topic = urlsplit("mqtt:"), None, ""
    if not parts.hostname or not topic:
        raise MissionInputError(f"{address}: `mqtt://[USER@]HOST[:PORT]/TOPIC` is expected, or `mqtts://`.")
    if parts.password is not None:
        raise MissionInputError(said("watch.password", variable=PASSWORD_VARIABLE))
    if many and (not topic.endswith("/+") or "+" in topic[:-1] or "#" in address):
        raise MissionInputError(f"{address}: a topic of many assets is expected, such as wings/+.")
    if not many and ("#" in address or "+" in topic):
        raise MissionInputError(f"{address}: a topic of one asset is expected, without `#` and `+`.")
    tls, user = parts.scheme == "mqtts", None if parts.username is None else unquote(parts.username)
    if authority is not None:
        if not (tls and authority.is_file()):
            raise MissionInputError(f"the certificate {authority} is a file, and belongs to mqtts://.")
        try:
            create_default_context(cafile=authority)
        except OSError as error:
            raise MissionInputError(f"{authority} holds no certificate: {error}.") from None
    return Broker(parts.hostname, port or (8883 if tls else 1883), topic, user, tls, authority)
