"""The flight live in Foxglove: the same channels as the recording, over a websocket. Off unless the mission asks for it."""

from __future__ import annotations

from typing import Any, Protocol

from flight.errors import RefusedError


class LiveView(Protocol):
    """A running server."""

    def stop(self) -> None:
        """End it; clients are disconnected."""


def start_live_view(context: Any, host: str, port: int) -> LiveView:
    """Serve `context`'s channels on ws://host:port. A slow client loses messages, never the flight. Raises `RefusedError`."""
    import foxglove  # noqa: PLC0415  (optional: extra `record`)

    try:
        server: LiveView = foxglove.start_server(
            name="fly",
            host=host,
            port=port,
            context=context,
            capabilities=[],
            supported_encodings=[],
            message_backlog_size=256,
        )
    except (OSError, RuntimeError, ValueError) as error:
        raise RefusedError(
            f"no live view on {host}:{port}: {error}; stop the program that uses this port or change recording.live_port"
        ) from None
    return server
