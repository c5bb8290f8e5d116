"""What all commands share. Users' mistakes end in one sentence on stderr and exit code 2.

3 means no adapter, 4 that device or memory gave out, 5 values that are not finite in a training, 130 (the shell's code)
that Ctrl-C ended the command.
"""

import argparse
import io
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from lapgs_wgpu.errors import DeviceError, InputError, NoAdapterError, NumericalError, quoted
from lapgs_wgpu.gpu.device import list_devices

DEVICE_HELP = (
    "graphics adapter: cpu, integrated or discrete, or part of the adapter's name [environment variable LAPGS_DEVICE, "
    "otherwise the first in the list of lapgs-train --list-devices]"
)
LIST_DEVICES_HELP = "list the graphics adapters and exit; the first one is the default unless LAPGS_DEVICE is set"


def guarded(name: str, command: Callable[[list[str]], int | None], arguments: Sequence[str] | None = None) -> int:
    """Run a command, with the arguments of this process where None; what its user should know goes to stderr in one
    sentence. Returns the exit code."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # letters that its encoding lacks are escaped, as on stderr
        utf8 = sys.platform == "win32" and not sys.stdout.isatty()
        sys.stdout.reconfigure(encoding="utf-8" if utf8 else None, errors="backslashreplace")
    text = ""
    try:
        code = command(list(sys.argv[1:] if arguments is None else arguments)) or 0
    except (InputError, NoAdapterError) as error:
        none = isinstance(error, NoAdapterError) and not list_devices()  # at all, or of the wanted name
        text, code = str(error), 3 if none else 2
    except (DeviceError, MemoryError) as error:
        text, code = str(error) or "out of memory.", 4
    except RuntimeError as error:
        if "allocate" not in str(error):  # torch's error for exhausted memory
            raise
        text, code = f"out of memory ({str(error).splitlines()[0]})", 4
    except NumericalError as error:
        text, code = str(error), 5
    except BrokenPipeError:  # nobody reads any more what is printed
        code = 0
    except OSError as error:  # such as a full disk, or missing permissions
        text, code = str(InputError(f"{error}; check the free space, the path and the permissions.")), 2
    except KeyboardInterrupt as error:
        text, code = str(error) or "interrupted.", 130
    if text:
        with suppress(OSError):  # the terminal may be gone
            print(f"{name}: {text}", file=sys.stderr)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:  # so that Python does not try again, in vain, at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return code


def beside(name: str) -> str:
    """How another of the commands is called: by its name where the shell finds it, otherwise as this one was."""
    return name if shutil.which(name) else quoted(Path(sys.argv[0]).with_name(name))


def print_devices() -> None:
    """The adapters, the default one first."""
    for info in list_devices():
        print(f"{info.name}  ({info.kind}, {info.backend}, {info.driver})")


class Parser(argparse.ArgumentParser):
    """argparse, with its help and its mistakes told in our way."""

    def __init__(self, name: str, description: str, **more: Any) -> None:
        width = min(shutil.get_terminal_size((120, 24)).columns, 120)
        formatter = partial(argparse.RawDescriptionHelpFormatter, max_help_position=32, width=width)
        super().__init__(name, description=description, formatter_class=formatter, allow_abbrev=False, **more)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; {self.prog} --help lists the options.")
