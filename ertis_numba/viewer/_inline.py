"""Live view in a cell of a notebook."""

import atexit
import logging
import socket
import threading
from pathlib import Path
from typing import Final, Self

from ertis_numba.base.errors import ErtisError
from ertis_numba.base.html_parts import escaped
from ertis_numba.viewer._choices import Choices
from ertis_numba.viewer._live import Live
from ertis_numba.viewer._playback import Playback
from ertis_numba.viewer._view import Viewer

__all__ = ["InlineView", "view"]

_LOG: Final = logging.getLogger("ertis_numba")
_SHARE: Final = 0.7
"""Size of the page in a cell, which is narrower than the windows for which it is designed."""
_FRAME: Final = (
    "<div style='height:36rem;overflow:hidden'><iframe src='{url}' title='{title}' style='width:{percent}%;"
    "height:{percent}%;border:0;transform:scale({share});transform-origin:0 0'></iframe></div>"
    "<p><a href='{url}' target='_blank'>{url}</a>. If Jupyter runs on another machine, first run "
    "<code>ssh -L {port}:127.0.0.1:{port} {host}</code> on yours.</p>"
)


class InlineView:
    """Page of a source, served by a thread on loopback until `close` or the end of the process; made by `view`.

    Jupyter shows it in the cell that ends with it.

    Attributes
    ----------
    url : str
        Address of the page for a browser on this machine.
    """

    def __init__(self, source: Live | Playback, *, choices: Choices | None, port: int) -> None:
        self._source = source
        self._viewer = Viewer(source, port=port, choices=choices, on_note=_LOG.warning)
        self.url = self._viewer.url
        self._thread = threading.Thread(target=self._run, name="ertis-inline-view", daemon=True)
        self._thread.start()
        atexit.register(self.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the view and its server; a second call has no effect."""
        self._viewer.stop()
        self._thread.join()
        atexit.unregister(self.close)

    def __repr__(self) -> str:
        return f"view of {self._source.title} " + (f"at {self.url}" if self._thread.is_alive() else "(closed)")

    def _repr_html_(self) -> str:
        """Return the page as a frame, for Jupyter."""
        if not self._thread.is_alive():
            return f"<p>{escaped(repr(self))}</p>"
        port = self.url.rstrip("/").rpartition(":")[2]
        title = escaped(f"live view of {self._source.title}")
        return _FRAME.format(
            url=self.url,
            title=title,
            share=_SHARE,
            percent=100 / _SHARE,
            port=port,
            host=escaped(socket.gethostname()),
        )

    def _run(self) -> None:
        try:
            with self._source, self._viewer:
                self._viewer.run()
        except ErtisError as error:  # The cell that made the view has ended.
            _LOG.error("the view of %s at %s ended: %s", self._source.title, self.url, error)


def view(source: str | Path | Live | Playback, *, choices: Choices | None = None, port: int = 0) -> InlineView:
    """Show live or recorded images or acoustic maps in a cell of a notebook.

    The page is that of ``ertis view``. Only this machine can open it. Notes on images and errors are logged.

    Parameters
    ----------
    source : str, Path, Live or Playback
        File, or address at which a central node publishes. `ertis_numba.viewer.Live` and
        `ertis_numba.viewer.Playback` have options, such as the sensors; the view closes them.
    choices : Choices, optional
        Initial choices of the page.
    port : int
        Port of the page; 0 chooses a free port.

    Returns
    -------
    InlineView
        Let a cell end with it to show it. Its method `close` ends the view.

    Raises
    ------
    ArgumentError
        The address cannot be used, or the extra 'view' is missing.
    DataError
        The file cannot be read or contains nothing.
    NetworkError
        The port cannot be used.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> shown = ertis.view("reflectors.h5")
    >>> shown.close()
    >>> shown
    view of reflectors.h5 (closed)
    """
    if isinstance(source, str | Path):
        source = Live(source) if isinstance(source, str) and "://" in source else Playback(source)
    try:
        return InlineView(source, choices=choices, port=port)
    except BaseException:
        source.__exit__()
        raise
