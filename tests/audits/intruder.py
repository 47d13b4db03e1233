"""Attack the cache of programs and the local cluster as another user of the same machine.

    python tests/audits/intruder.py        as root (it runs the attacks as the user nobody)

Printed: a line for each attack. Exit code 1 where one succeeds.
"""

import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from jaxtank.xla import jit, program_cache

NOBODY = 65534
RUN = ["simulate", "cascaded/pi", "--json", "--dt", "8"]


class Touch:
    """Unpickled, it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"touch {self.path}",)


def run(cache, *words):
    """Run the command with its programs in a folder."""
    env = {n: v for n, v in os.environ.items() if not n.startswith("JAX_")}
    env |= {"JAXTANK_CACHE": str(cache)}
    command = [sys.executable, "-m", "jaxtank", *words]
    return subprocess.run(command, capture_output=True, text=True, env=env, check=True)


def planted(entry, mark):
    """The bytes of an entry with a program of ours instead of the compiled one."""
    data = entry.read_bytes()
    size = jit.SIZE + int.from_bytes(data[: jit.SIZE], "little")
    json.loads(data[jit.SIZE : size])
    return data[:size] + pickle.dumps(Touch(mark))


def plant(base, folder, texts):
    """As nobody: make the folder of a version in an open base, with entries and their digests."""
    child = os.fork()
    if child == 0:
        os.setgroups([])
        os.setgid(NOBODY)
        os.setuid(NOBODY)
        (base / folder).mkdir(mode=0o777)
        for name, data in texts.items():
            (base / folder / name).write_bytes(data)
        program_cache.seal(base / folder, 0.0)
        os._exit(0)
    os.waitpid(child, 0)


def cache_attack(folder):
    """Whether a program that another user left in an open folder runs, after each remedy."""
    base, mark, outcome = folder / "kept", folder / "mark", []
    run(folder / "model", *RUN)
    (version,) = (p for p in (folder / "model").iterdir() if p.is_dir())
    entries = list(version.glob(f"*{jit.ENDING}"))
    base.mkdir()
    base.chmod(0o777)
    plant(base, version.name, {p.name: planted(p, mark) for p in entries})
    message = run(base, *RUN).stderr
    base.chmod(0o700)
    run(base, *RUN)
    for path in (base / version.name, *(base / version.name).iterdir()):
        path.chmod(0o700)
    message += run(base, *RUN).stderr
    outcome.append(
        f"programs planted, folder closed afterwards: {'RUN' if mark.exists() else 'not run'}"
    )
    outcome.append(f"  {message.strip()}")
    return mark.exists(), outcome


def cluster_attack(folder):
    """Whether nobody can run code in a local cluster, and which addresses it listens on."""
    words = [sys.executable, "-m", "jaxtank", "uncertainty", "gouta2015/ngpc", "--samples", "6000"]
    begun = subprocess.Popen([*words, "--cluster", "local:1"], stdout=-3, stderr=-3)
    listeners, until = set(), time.monotonic() + 90
    code = (
        "import distributed, os, sys\n"
        "os.setgroups([]); os.setgid(65534); os.setuid(65534); os.environ['HOME'] = '/'\n"
        "client = distributed.Client(sys.argv[1], timeout=4, set_as_default=False)\n"
        "print('uid', client.run_on_scheduler(os.getuid))\n"
    )
    try:
        while len(listeners) < 3 and begun.poll() is None and time.monotonic() < until:
            main = psutil.Process(begun.pid)
            for process in (main, *main.children(recursive=True)):
                connections = process.net_connections(kind="inet")
                listeners |= {c.laddr for c in connections if c.status == psutil.CONN_LISTEN}
            time.sleep(0.3)
        let_in = []
        for (ip, port), kind in ((a, k) for a in sorted(listeners) for k in ("tcp", "tls")):
            attack = [sys.executable, "-c", code, f"{kind}://{ip}:{port}"]
            try:
                done = subprocess.run(attack, capture_output=True, text=True, timeout=15)
            except subprocess.TimeoutExpired:
                continue
            if "uid" in done.stdout:
                let_in.append(f"{kind}://{ip}:{port}: {done.stdout.strip()}")
    finally:
        begun.kill()
        begun.wait()
    outside = [a for a in listeners if a.ip != "127.0.0.1"]
    words = f"{len(listeners)} listeners, {len(outside)} of them not on 127.0.0.1; let in: "
    return bool(let_in or outside or len(listeners) < 3), [words + (", ".join(let_in) or "nobody")]


def main():
    if os.geteuid() != 0:
        sys.exit("needs to be root, to act as another user")
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        failed = []
        for attack in (cache_attack, cluster_attack):
            success, lines = attack(Path(name))
            failed.append(success)
            print("\n".join(lines), flush=True)
    return int(any(failed))


if __name__ == "__main__":
    sys.exit(main())
