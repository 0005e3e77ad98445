"""Links to drones with one narrow interface (`base.Link`); `open_link` chooses a link by the scheme of the URI."""

from urllib.parse import urlsplit

from crazyem.errors import UsageError
from crazyem.links.base import Link

CRAZYFLIE_SCHEMES = ("udp", "radio", "usb", "serial", "tcp", "prrt")

__all__ = ["open_link"]


def open_link(uri: str) -> Link:
    """The link for a URI, not yet connected. Raises UsageError if the URI names no known link."""
    if uri.startswith("mavlink:"):
        from crazyem.links.mavlink.link import MavlinkLink

        return MavlinkLink(uri)
    scheme, separator, _ = uri.partition("://")
    if not separator:
        raise UsageError(
            f'"{uri}" is not a link URI; it should look like udp://127.0.0.1:19850, radio://0/80/2M or '
            "mavlink:udpin:0.0.0.0:14550."
        )
    if scheme not in CRAZYFLIE_SCHEMES:
        known = ", ".join(f"{s}://" for s in CRAZYFLIE_SCHEMES)
        raise UsageError(f'"{uri}": no link for {scheme}://; known are {known}.')
    if scheme in ("udp", "tcp"):
        try:
            parts = urlsplit(uri)
            sound = parts.hostname is not None and parts.port is not None
        except ValueError:
            sound = False
        if not sound:
            raise UsageError(f'"{uri}" needs a host and a port, such as {scheme}://127.0.0.1:19850.')
    from crazyem.links.crazyflie import CrazyflieLink

    return CrazyflieLink(uri)
