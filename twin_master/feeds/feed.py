"""The interface of a feed, which gives messages to a watch and takes its decisions."""

from collections.abc import Callable, Iterable, Iterator

from reporting.json_file import JsonRecord
from twin_master.feeds.lines import Position
from twin_master.feeds.message import FeedItem

Decision = JsonRecord
"""A decision as it is published; `docs/how_to/watch.md` lists its keys."""
DecisionSink = Callable[[Decision], object]
"""A function that is called with each decision, once its step is in the journal."""


class Feed:
    """A source of messages.

    This class is a feed whose messages cannot be read twice: a resumed watch takes what comes next.

    Parameters
    ----------
    items : iterable of FeedItem
        The messages.
    """

    replayable = False
    """Whether a resumed watch can read the messages again from the beginning of the feed."""
    has_every_message = True
    """Whether the feed gives all messages of a logger, of which `watch.every` may thin out."""
    position: Position | None = None
    """The position after the message that was given last, if the feed is a file."""

    def __init__(self, items: Iterable[FeedItem] = ()) -> None:
        self._items = items

    @property
    def waiting_messages(self) -> int:
        """The number of messages that have come and are not read yet; 0 if it is not known."""
        return 0

    def contains_position(self, position: Position) -> bool:
        """Return whether a position belongs to this feed; false for a feed without positions."""
        return False

    def messages(self, position: Position | None) -> Iterator[FeedItem]:
        """Yield the messages after a position; all of them if it is None."""
        return iter(self._items)

    def send_decision(self, decision: Decision) -> None:
        """Send a decision to the publisher of the messages, if it listens."""

    def release_file(self) -> None:
        """Close the file of the feed, if it has one, until the next message is asked for."""

    def close(self) -> None:
        """Release the connection to the publisher of the messages, or close the file."""
