"""Which server shows a scene: the page, or Foxglove's protocol."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Final

from bags.viewing.foxglove import serve_foxglove
from bags.viewing.page import serve_page
from bags.viewing.scene import Scene
from nlsid_core.errors import DataError

PORTS: Final = {False: 8765, True: 8080}  # Foxglove's own, and the page's
LOCAL: Final = "127.0.0.1"


@contextmanager
def serve(scene: Scene, *, page: bool, host: str, port: int) -> Iterator[str]:
    """Serve until the block ends; gives the address. port 0: the usual one of its kind.

    DataError if there can be no server there, or foxglove-sdk is not installed.
    """
    port = port or PORTS[page]
    server = (serve_page if page else serve_foxglove)(scene, host=host, port=port)
    with ExitStack() as stack:
        try:
            address = stack.enter_context(server)
        except (OSError, RuntimeError) as error:
            raise DataError(f"cannot serve on {host}, port {port}: {error}") from error
        yield address
