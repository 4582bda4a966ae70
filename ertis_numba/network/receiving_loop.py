"""Base class of receivers: a loop over received items."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Generic, Self, TypeVar

__all__ = ["ReceivingLoop"]

Item_co = TypeVar("Item_co", covariant=True)


class ReceivingLoop(ABC, Generic[Item_co]):
    """Receiver for use in a ``with`` statement and a loop; the loop ends when `close` is called."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Item_co]:
        while (item := self.receive()) is not None:
            yield item

    @abstractmethod
    def receive(self, timeout_s: float | None = None) -> Item_co | None:
        """Return the next item; None after ``timeout_s``, or once the receiver is closed."""

    @abstractmethod
    def close(self) -> None:
        """End the loop."""
