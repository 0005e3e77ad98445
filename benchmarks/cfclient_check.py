"""Does the graphical client accept the simulator? Drives cfclient without a screen against a URI.

Run it with the interpreter of an environment of its own (`pip install cfclient==2026.8.1`; on Debian the Qt libraries
libegl1 libgl1 libxkbcommon0 libdbus-1-3 libfontconfig1 must be there):

    python benchmarks/cfclient_check.py udp://127.0.0.1:19850 [--seconds 5] [--timeout 60]

Opens the main window with all its tabs, connects, waits until every parameter has been read, lets the client's own log
blocks run for some seconds, writes a parameter back (impossible after an error in a parameter callback), and
disconnects. Exit code 0 if all worked without a logged error or an exception in any thread, 1 otherwise.
"""

import argparse
import logging
import os
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from types import TracebackType


class Collector(logging.Handler):
    """Keeps logged errors and exceptions, and uncaught exceptions."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.troubles: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Collect a record of level ERROR or above, or with an exception."""
        if record.levelno >= logging.ERROR or record.exc_info:
            self.troubles.append(f"logged by {record.name}: {record.getMessage()}")

    def raised(self, kind: type[BaseException], value: BaseException | None, trace: TracebackType | None) -> None:
        """Collect an uncaught exception."""
        self.troubles.append("".join(traceback.format_exception(kind, value, trace)))


def main() -> int:
    """Run the check; prints what happened."""
    parser = argparse.ArgumentParser(description="Connect cfclient, without a screen, to a URI.")
    parser.add_argument("uri")
    parser.add_argument("--seconds", type=float, default=5.0, help="how long to stay connected")
    parser.add_argument("--timeout", type=float, default=60.0, help="how long the connection may take")
    arguments = parser.parse_args()

    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    collector = Collector()
    logging.getLogger().addHandler(collector)
    sys.excepthook = collector.raised
    threading.excepthook = lambda args: collector.raised(args.exc_type, args.exc_value, args.exc_traceback)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CONFIG_HOME"] = folder  # a new client: no cache, no configuration
        troubles = check(arguments.uri, arguments.seconds, arguments.timeout) + collector.troubles
    for trouble in troubles:
        print(f"TROUBLE {trouble}")
    print("cfclient: failed" if troubles else "cfclient: fully connected, nothing raised")
    sys.stdout.flush()
    os._exit(1 if troubles else 0)  # its threads do not end by themselves


def check(uri: str, seconds: float, timeout: float) -> list[str]:
    """Connect, stay, write a parameter, disconnect. Returns what went wrong."""
    from cfclient.ui.main import MainUI
    from PyQt6.QtWidgets import QApplication, QMessageBox

    troubles: list[str] = []
    for name in ("critical", "about", "warning"):  # a dialogue would wait for a click
        setattr(QMessageBox, name, lambda *args: troubles.append(f"dialogue: {args[-1]}"))
    app = QApplication(["cfclient"])
    window = MainUI()
    window.show()

    def wait(condition: Callable[[], bool], limit: float) -> bool:
        end = time.monotonic() + limit
        while time.monotonic() < end and not condition():
            app.processEvents()
            time.sleep(0.005)
        return condition()

    connected, data = threading.Event(), threading.Event()
    window.cf.fully_connected.add_callback(lambda _uri: connected.set())
    window.batteryUpdatedSignal.connect(lambda *_args: data.set())
    for tab in window.loaded_tab_toolboxes.values():  # all tabs, not only those that a new user sees
        window._tab_toolbox_show_as_tab(tab)
    wait(lambda: False, 1.0)  # the window's first scan
    window._connectivity_manager.set_interfaces([uri], 0)
    begin = time.monotonic()
    window._connect()
    if not wait(connected.is_set, timeout):
        return [*troubles, f"not fully connected within {timeout:g} s"]
    print(f"fully connected in {time.monotonic() - begin:.2f} s, {window.tab_widget.count()} tabs")
    for index in range(window.tab_widget.count()):
        window.tab_widget.setCurrentIndex(index)
        wait(lambda: False, 0.2)
    if not wait(data.is_set, 5.0):
        troubles.append("the battery log block gave no data")
    echoed = threading.Event()
    window.cf.param.add_update_callback(group="hlCommander", name="vtoff", cb=lambda _name, _value: echoed.set())
    wait(lambda: False, seconds)
    echoed.clear()
    window.cf.param.set_value("hlCommander.vtoff", "0.4")
    if not wait(echoed.is_set, 5.0):
        troubles.append("a parameter write was not confirmed")
    if not window.cf.is_connected():
        troubles.append("the connection did not last")
    window.cf.close_link()
    wait(lambda: False, 0.5)
    return troubles


if __name__ == "__main__":
    sys.exit(main())
