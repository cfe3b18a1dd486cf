"""Network namespaces as separate computers on one cable: a bridge, and a veth pair for each robot. Needs root and `ip`.

Everything lives in namespaces of its own, the bridge too: nothing of the computer's own network is touched, and with
the namespaces all of it is gone.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from deploy.agent_files import Host

NETWORK = "10.83.0"


def run(*words: str) -> str:
    """Carry out a command. Raises RuntimeError with what it said."""
    done = subprocess.run(words, capture_output=True, text=True, timeout=20, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(words)}: {done.stderr.strip()}")
    return done.stdout


def missing() -> str | None:
    """Why this computer cannot do it; None if it can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    for tool in ("ip", "nsenter"):
        if shutil.which(tool) is None:
            return f"network namespaces need the command {tool}"
    try:
        with Lan(["probe"]):
            return None
    except RuntimeError as error:
        return f"no network namespaces here: {error}"


def firewall() -> str | None:
    """The firewall there is, if any."""
    return next((tool for tool in ("nft", "iptables") if shutil.which(tool) is not None), None)


class Lan:
    """Robots on one bridge, within a `with`; processes that are left in the namespaces are killed by their ids."""

    def __init__(self, robots: Sequence[str]) -> None:
        self._prefix = f"cofix-{os.getpid()}"
        self._switch = f"{self._prefix}-switch"
        self.hosts = {
            robot: Host(f"{self._prefix}-{robot}", f"{NETWORK}.{k}") for k, robot in enumerate(robots, start=1)
        }
        self.left: list[int] = []
        """Processes that were still there at the end."""

    def __enter__(self) -> Self:
        try:
            run("ip", "netns", "add", self._switch)
            run("ip", "-n", self._switch, "link", "add", "switch", "type", "bridge")
            run("ip", "-n", self._switch, "link", "set", "switch", "up")
            for robot, host in self.hosts.items():
                port = self._port(robot)
                run("ip", "netns", "add", host.namespace)
                cable = ("type", "veth", "peer", "name", "eth0", "netns", host.namespace)
                run("ip", "-n", self._switch, "link", "add", port, *cable)
                run("ip", "-n", self._switch, "link", "set", port, "master", "switch", "up")
                run("ip", "-n", host.namespace, "addr", "add", f"{host.address}/24", "dev", "eth0")
                for device in ("lo", "eth0"):
                    run("ip", "-n", host.namespace, "link", "set", device, "up")
        except BaseException:
            self._remove()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._remove()

    def _remove(self) -> None:
        for name in self.namespaces():
            self.left += [int(pid) for pid in run("ip", "netns", "pids", name).split()]
            for pid in self.left:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            run("ip", "netns", "del", name)

    def namespaces(self) -> list[str]:
        """Namespaces of this network that there are; others may run beside it."""
        folder = Path("/run/netns")
        found = folder.iterdir() if folder.exists() else ()
        return sorted(path.name for path in found if path.name.startswith(f"{self._prefix}-"))

    @staticmethod
    def _port(robot: str) -> str:
        return f"p-{robot}"[:15]

    # -- faults ---------------------------------------------------------------------------------------------

    def vanish(self, robot: str) -> None:
        """Out of radio range: no packet goes either way, and no carrier tells."""
        run("ip", "-n", self._switch, "link", "set", self._port(robot), "nomaster")

    def appear(self, robot: str) -> None:
        """In range again."""
        run("ip", "-n", self._switch, "link", "set", self._port(robot), "master", "switch")

    def link_down(self, robot: str) -> None:
        """The robot's own interface goes down."""
        run("ip", "-n", self.hosts[robot].namespace, "link", "set", "eth0", "down")

    def link_up(self, robot: str) -> None:
        run("ip", "-n", self.hosts[robot].namespace, "link", "set", "eth0", "up")

    def drop(self, robot: str) -> None:
        """The robot's firewall drops all that comes in from others."""
        inside = ("ip", "netns", "exec", self.hosts[robot].namespace)
        if firewall() == "nft":
            run(
                *inside,
                "nft",
                "add table inet cut; add chain inet cut in { type filter hook input priority 0; };"
                " add rule inet cut in iifname eth0 drop",
            )
        else:
            run(*inside, "iptables", "-A", "INPUT", "-i", "eth0", "-j", "DROP")

    def let_through(self, robot: str) -> None:
        inside = ("ip", "netns", "exec", self.hosts[robot].namespace)
        if firewall() == "nft":
            run(*inside, "nft", "delete table inet cut")
        else:
            run(*inside, "iptables", "-D", "INPUT", "-i", "eth0", "-j", "DROP")
