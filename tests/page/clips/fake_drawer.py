"""Stands in for `prefrl.page.clips.worker`: does what `orders.json` in the folder says.

Of each candidate, attempt by attempt: "draw", "hang", "crash", "garbage", "lie", "error", "passing", or "wait" (until
the file `go` is there).
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

folder = Path(sys.argv[1])
BOXES = b"".join((8 + len(b)).to_bytes(4, "big") + k + b for k, b in ((b"ftyp", b""), (b"moov", b""), (b"mdat", b"x")))


def obey(order: str, candidate: str, file: str) -> dict[str, object]:
    if order == "hang":
        sleeper = subprocess.Popen(["sleep", "60"])
        (folder / "sleeper").write_text(str(sleeper.pid))
        time.sleep(60)
    elif order == "crash":
        sys.stderr.write("a driver gave up\n")
        sys.stderr.flush()
        os.abort()
    elif order == "garbage":
        return {"file": "another"}
    elif order in ("error", "passing"):
        return {"file": file, "error": "it has no states", "lasting": order == "error"}
    elif order == "wait":
        while not (folder / "go").exists():
            time.sleep(0.01)
    if order != "lie":
        (folder / "clips" / file[:2]).mkdir(parents=True, exist_ok=True)
        (folder / "clips" / file[:2] / file).write_bytes(BOXES)
    return {"file": file, "bytes": len(BOXES)}


for line in sys.stdin:
    job = json.loads(line)
    with (folder / "attempts").open("a") as attempts:
        attempts.write(f"{job['candidate'][:4]} {os.getpid()}\n")
    said = json.loads((folder / "orders.json").read_text()) if (folder / "orders.json").exists() else {}
    orders = said.get(job["candidate"][:4], ["draw"])
    tried = [one.split()[0] for one in (folder / "attempts").read_text().splitlines()].count(job["candidate"][:4])
    reply = obey(orders[min(tried, len(orders)) - 1], job["candidate"], job["file"])
    sys.stdout.write(json.dumps(reply) + "\n")
    sys.stdout.flush()
