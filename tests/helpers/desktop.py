"""A screen without a monitor (Xvfb), real mouse and key events on it (xdotool), and what it shows."""

import os
import shutil
import signal
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import numpy as np
import pytest
from helpers.waiting import PATIENCE
from numpy.typing import NDArray

SIZE = (1024, 768)


class Desktop:
    """A virtual screen with the programs that run on it. A context manager; skips the test where tools are missing."""

    def __init__(self) -> None:
        for tool in ("Xvfb", "xdotool"):
            if shutil.which(tool) is None:
                pytest.skip(f"{tool} is not installed")
        self._folder = tempfile.TemporaryDirectory()
        self._processes: list[subprocess.Popen[str]] = []

    def __enter__(self) -> "Desktop":
        read, write = os.pipe()
        command = ["Xvfb", "-displayfd", str(write), "-screen", "0", f"{SIZE[0]}x{SIZE[1]}x24", "-nolisten", "tcp"]
        # Without -noreset it starts anew, and takes no connections meanwhile, whenever the last program has left.
        command += ["-noreset", "-fbdir", self._folder.name]
        self._server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
        os.close(write)
        with os.fdopen(read) as pipe:
            self.display = f":{pipe.readline().strip()}"
        for _ in range(50):  # it names the display a little before it takes connections
            if (
                subprocess.run(["xdotool", "getmouselocation"], env=self._environment(), capture_output=True).returncode
                == 0
            ):
                return self
            time.sleep(0.1)
        raise AssertionError(f"Xvfb takes no connections on {self.display}")

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for process in (*self._processes, self._server):
            process.kill()
            process.wait()
        self._folder.cleanup()

    def _environment(self) -> dict[str, str]:
        environment = {**os.environ, "DISPLAY": self.display, "MESA_VK_WSI_PRESENT_MODE": "immediate"}
        environment.pop("WAYLAND_DISPLAY", None)
        return environment

    def start(self, *command: str) -> subprocess.Popen[str]:
        """Run a program on this screen; it is ended with the screen."""
        process = subprocess.Popen(command, env=self._environment(), stderr=subprocess.PIPE, text=True)
        self._processes.append(process)
        return process

    def events(self, *words: str | int) -> None:
        """Mouse and key events in xdotool's words."""
        command = ["xdotool", *map(str, words)]
        subprocess.run(command, env=self._environment(), check=True, timeout=PATIENCE)

    def drag(self, start: tuple[int, int], end: tuple[int, int], steps: int = 8) -> None:
        """Press the left button, move in steps, release."""
        self.events("mousemove", *start)
        time.sleep(0.2)
        self.events("mousedown", 1)
        for i in range(1, steps + 1):
            self.events("mousemove", *(round(a + (b - a) * i / steps) for a, b in zip(start, end, strict=True)))
            time.sleep(0.05)
        self.events("mouseup", 1)

    def picture(self) -> NDArray[np.int32]:
        """(height, width, 3) of the whole screen, from the server's frame buffer in xwd's format."""
        data = (Path(self._folder.name) / "Xvfb_screen0").read_bytes()
        header = struct.unpack(">25I", data[:100])
        width, height, pitch, colors = header[4], header[5], header[12], header[19]
        pixels = np.frombuffer(data, np.uint8, height * pitch, header[0] + 12 * colors).reshape(height, pitch)
        return pixels[:, : 4 * width].reshape(height, width, 4)[..., 2::-1].astype(np.int32)

    def wait_for(self, true: Callable[[NDArray[np.int32]], bool], what: str) -> NDArray[np.int32]:
        """The screen, once it is as wanted and has come to rest."""
        return self._wait(true, what, at_rest=True)

    def wait_for_change(self, true: Callable[[NDArray[np.int32]], bool], what: str) -> NDArray[np.int32]:
        """The screen as soon as it is as wanted, though it may go on changing."""
        return self._wait(true, what, at_rest=False)

    def _wait(self, true: Callable[[NDArray[np.int32]], bool], what: str, *, at_rest: bool) -> NDArray[np.int32]:
        end = time.monotonic() + PATIENCE
        before = self.picture()
        while time.monotonic() < end:
            time.sleep(0.4)
            now = self.picture()
            if true(now) and (not at_rest or np.array_equal(now, before)):
                return now
            before = now
        errors = []
        for process in self._processes:
            process.send_signal(signal.SIGINT)
            time.sleep(2)
            process.kill()
            errors.append(process.communicate()[1])
        raise AssertionError(f"the screen never came to show {what}\n" + "\n".join(errors))
