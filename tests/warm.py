"""The command `prefrl` without the seconds that its imports take: forked from a process that has imported them.

In the place of the installed command stands a client, which hands its arguments, folder, environment and open files
over, passes Ctrl-C on, and ends with the status of the command. Those that a command starts itself by
`sys.executable -m prefrl` are forked as well.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

PRELOADED = (
    "prefrl.cli.main", "prefrl.cli.console", "prefrl.rundir", "prefrl.stages", "prefrl.duel", "prefrl.envs.text",
    "prefrl.label.web", "matplotlib.backends.backend_svg", "scipy.optimize", "scipy.stats", "torch._dynamo",
    "torch.utils.tensorboard", "transformers",
)  # fmt: skip
"""None of these starts a thread or computes anything, so a process that has imported them can be forked."""
CLIENT = """\
#!{python} -IS
import json, os, signal, socket, sys

asked = sys.argv[1:]
if sys.argv[0].endswith("python"):
    if asked[:2] != ["-m", "prefrl"]:
        os.execv({python!r}, [{python!r}, *asked])
    asked = asked[2:]
place = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
place.connect({address!r})
told = json.dumps([asked, os.getcwd(), dict(os.environ)]).encode()
socket.send_fds(place, [len(told).to_bytes(8, "big")], [0, 1, 2])
place.sendall(told)
answers = place.makefile()
pid = int(answers.readline())
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda number, _: os.kill(pid, number))
sys.exit(int(answers.readline()))
"""


@contextmanager
def commands(folder: Path) -> Iterator[Path]:
    """A folder for PATH with such a command in it, and with the `python` that it starts others by."""
    folder.mkdir()
    address = str(folder / "place")
    for name in ("prefrl", "python"):
        client = folder / name
        client.write_text(CLIENT.format(python=sys.executable, address=address))
        client.chmod(0o755)
    with subprocess.Popen([sys.executable, __file__, address], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as server:
        assert server.stdin is not None
        assert server.stdout is not None
        assert server.stdout.readline(), "it did not start"
        yield folder
        server.stdin.close()  # it ends then, as it does where this process is killed


def serve(address: str) -> None:
    """Fork for each command that is asked for; return in those that are to be commands."""
    for name in PRELOADED:
        import_module(name)
    gc.freeze()  # a collection would write to every page, and copy it
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listening:
        listening.bind(address)
        listening.listen()
        print("ready", flush=True)
        while sys.stdin not in select.select([listening, sys.stdin], [], [])[0]:
            asked, _ = listening.accept()
            if not os.fork():
                break
            asked.close()
            while _ended():
                pass
        else:
            os._exit(0)
    if child := os.fork():
        _watch(asked, child)
    _become(asked)


def _ended() -> bool:
    """Whether a child had ended that nobody had asked about yet."""
    try:
        return os.waitpid(-1, os.WNOHANG) != (0, 0)
    except ChildProcessError:
        return False


def _watch(asked: socket.socket, child: int) -> None:
    asked.sendall(f"{child}\n".encode())
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    asked.sendall(f"{status if status >= 0 else 128 - status}\n".encode())
    os._exit(0)


def _become(asked: socket.socket) -> None:
    size, files, _, _ = socket.recv_fds(asked, 8, 3)
    sys.executable = str(Path(asked.getsockname()).with_name("python"))
    with asked, asked.makefile("rb") as reader:
        arguments, folder, environment = json.loads(reader.read(int.from_bytes(size, "big")))
    for number, file in enumerate(files):
        os.dup2(file, number)
        os.close(file)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = ["prefrl", *arguments]


def _end(status: int) -> None:
    """As Python ends, but for taking all modules down one by one: that would copy the memory which is shared here."""
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)


if __name__ == "__main__":
    serve(sys.argv[1])
    from prefrl.cli.main import main

    try:
        main()
    except SystemExit as error:
        _end(int(error.code or 0))
    except BaseException:
        traceback.print_exc()
        _end(1)
    _end(0)
