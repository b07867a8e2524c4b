"""Runs ``pointsplat`` commands one after another in this process, cut off from the network, and
writes what each did.

    python bare_machine.py < COMMANDS.json

A command is a list of words; of each are said what it printed, its exit status and the hosts that
it tried to reach. Views are as small as in the other tests.
"""

import io
import json
import sys
import traceback
from contextlib import redirect_stderr, redirect_stdout

from quick import quick_settings

tried: list[str] = []


def no_network(event: str, arguments: tuple) -> None:
    """Fail whatever asks for a host's address or connects to one, as on a machine without
    network."""
    if event in ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto"):
        tried.append(f"{event} {arguments}")
        raise OSError(101, "Network is unreachable")


def outcome(words: list[str]) -> dict:
    from pointsplat_ns.cli import main

    tried.clear()
    status = 0
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        try:
            main(words)
        except SystemExit as end:
            status = end.code
        except Exception:
            traceback.print_exc()
            status = -1
    return {"status": status, "out": out.getvalue(), "err": err.getvalue(), "tried": [*tried]}


if __name__ == "__main__":
    sys.addaudithook(no_network)
    with quick_settings():
        print(json.dumps([outcome(words) for words in json.load(sys.stdin)]))
