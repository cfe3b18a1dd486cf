"""The command line: `cofix run`, `montecarlo`, `agent`, `fault`, `sitl`, `replay`, `report`.

Exit status: 0 done, 1 the run failed its own expectations or an agent died, 2 wrong use, with one line that says
what to change.
"""

from __future__ import annotations

import os

# Small matrices: more threads only get in each other's way, and sums would depend on their number.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse  # noqa: E402
import asyncio  # noqa: E402
import json  # noqa: E402
import logging  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import NoReturn  # noqa: E402

MAX_SEED = 2**63 - 1


class Parser(argparse.ArgumentParser):
    """Answers wrong use with one line instead of the whole usage."""

    def error(self, message: str) -> NoReturn:
        line = " ".join(message.split())
        self.exit(2, f"{self.prog}: {line}; see {self.prog} --help\n")


def _number(text: str, what: str, low: float) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{what} must be a number, not '{text}'") from None
    if not low < value < 1e9:
        raise argparse.ArgumentTypeError(f"{what} must lie between {low:g} and 1e9, not {text}")
    return value


def _seconds(text: str) -> float:
    return _number(text, "seconds", 0.0)


def _speed(text: str) -> float:
    return _number(text, "speed", 0.0)


def _count(text: str) -> int:
    value = _number(text, "the number", 0.0)
    if value != int(value):
        raise argparse.ArgumentTypeError(f"a whole number is needed, not '{text}'")
    return int(value)


def _seed(text: str) -> int:
    if not text.isdecimal() or int(text) > MAX_SEED:
        raise argparse.ArgumentTypeError(f"a whole number from 0 to {MAX_SEED} is needed, not '{text}'")
    return int(text)


def usable_cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def parser() -> Parser:
    """The whole command line."""
    root = Parser(prog="cofix", description="Robots that cannot trust GPS locate each other.")
    commands = root.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def scenario_options(command: argparse.ArgumentParser) -> None:
        command.add_argument("--seed", type=_seed, default=1, help="every random number follows from it (default 1)")
        command.add_argument(
            "--set", action="append", default=[], metavar="KEY=VALUE", help="override a key, e.g. links.loss=0.3"
        )
        command.add_argument("--bound", action="store_true", help="also run the centralized filter on the same data")
        command.add_argument("--check", action="store_true", help="check invariants after every event (virtual time)")
        command.add_argument("--out", type=Path, help="run directory (default: runs/NAME-TIME)")
        command.add_argument("--json", action="store_true", help="print summary.json alone on standard output")
        command.add_argument("--no-report", action="store_true", help="draw no report; `cofix report` does so later")
        command.add_argument("--duration", type=_seconds, metavar="S", help="play only so many seconds")

    run = commands.add_parser("run", help="run a scenario once; without a name, the demo")
    run.add_argument("scenario", nargs="?", help="a bundled name or a file; default: the demo")
    run.add_argument("--runtime", choices=("virtual", "processes"), help="default: virtual (the demo: processes)")
    run.add_argument("--speed", type=_speed, default=1.0, help="fleet time per wall time, processes only (default 1)")
    scenario_options(run)

    montecarlo = commands.add_parser("montecarlo", help="many trials of a scenario in virtual time")
    montecarlo.add_argument("scenario", help="a bundled name or a file")
    montecarlo.add_argument("--trials", type=_count, required=True, metavar="N")
    montecarlo.add_argument(
        "--jobs", type=_count, default=usable_cores(), metavar="J", help="processes (default: the usable cores)"
    )
    montecarlo.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="KEY=A,B",
        help="the same trials with each value of a key; given twice, with every combination",
    )
    montecarlo.add_argument(
        "--resume", action="store_true", help="go on with the trials kept in --out; --trials may be more than before"
    )
    scenario_options(montecarlo)

    agent = commands.add_parser("agent", help="run one agent from its configuration file")
    agent.add_argument("config", type=Path)

    fault = commands.add_parser("fault", help="inject a fault by hand into a run of processes that goes on")
    fault.add_argument(
        "words",
        nargs="+",
        metavar="[RUN_DIR] KIND VALUE|KEY=VALUE ...",
        help="a kind of fault and its keys as in [[faults]]; or 'list', or 'end NAME'; default: the newest run",
    )
    fault.add_argument("--for", dest="lasting", type=_seconds, metavar="S", help="so long; default: to the end")
    fault.add_argument("--links", metavar="ID,ID", help="only on the links among these robots")
    fault.add_argument("--json", action="store_true", help="print the answer as JSON")

    sitl = commands.add_parser("sitl", help="an autopilot stand-in that drives a circle, for desk tests")
    sitl.add_argument("--endpoint", default="udpout:127.0.0.1:14550", help="where the companion listens")
    sitl.add_argument("--system-id", type=_count, default=1)
    sitl.add_argument("--flavour", choices=("ardupilot", "px4"), default="ardupilot")
    sitl.add_argument("--gps", action="store_true", help="send global position and absolute yaw too")
    sitl.add_argument("--radius", type=_seconds, default=8.0, metavar="M")
    sitl.add_argument("--vehicle-speed", type=_seconds, default=0.3, metavar="MPS")

    replay = commands.add_parser("replay", help="play a recording into fresh cores and compare what they do")
    replay.add_argument("recording", type=Path)
    replay.add_argument("--robot", help="only this one")

    report = commands.add_parser("report", help="write the report of a run directory again, or compare several runs")
    report.add_argument("directories", type=Path, nargs="+", metavar="DIR")
    report.add_argument("--out", type=Path, help="of a comparison (default: runs/comparison-TIME)")
    return root


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    try:
        options = parser().parse_args(arguments)
        options.arguments = sys.argv[1:] if arguments is None else arguments
    except SystemExit as end:
        return int(end.code or 0)
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    handlers = {
        "run": _run,
        "montecarlo": _montecarlo,
        "agent": _agent,
        "fault": _fault,
        "sitl": _sitl,
        "replay": _replay,
        "report": _report,
    }
    from agent.config_file import ConfigError

    try:
        return handlers[options.command](options)
    except ConfigError as error:
        return fail(str(error))
    except KeyboardInterrupt:
        print("cofix: interrupted", file=sys.stderr)
        return 1


def fail(message: str) -> int:
    """One line about wrong use; exit status 2."""
    print(f"cofix: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _run(options: argparse.Namespace) -> int:
    from deploy.runs import run

    return run(options)


def _montecarlo(options: argparse.Namespace) -> int:
    from deploy.montecarlo import montecarlo

    return montecarlo(options)


def _agent(options: argparse.Namespace) -> int:
    from agent.config import load_agent_config
    from agent.mavlink_endpoint import MavlinkError
    from agent.shell import AgentShell
    from network.transport import TransportError

    config = load_agent_config(options.config)
    try:
        asyncio.run(AgentShell(config).run())
    except (TransportError, MavlinkError) as error:
        return fail(str(error))
    except (ConnectionError, FileNotFoundError) as error:
        return fail(f"control_socket {config.control_socket}: {error.strerror}; start the run with 'cofix run'")
    return 0


def _fault(options: argparse.Namespace) -> int:
    from deploy.fault import fault

    return fault(options)


def _sitl(options: argparse.Namespace) -> int:
    from deploy.vehicle import drive_circle

    return drive_circle(options)


def _replay(options: argparse.Namespace) -> int:
    from agent.recording import RecordingError, read_agents, replay

    try:
        robots = sorted(read_agents(options.recording))
        if options.robot is not None and options.robot not in robots:
            return fail(f"{options.recording}: no robot '{options.robot}'; it holds {', '.join(robots)}")
        differing = 0
        for robot in robots if options.robot is None else [options.robot]:
            events, effects, broken = replay(options.recording, robot)
            if broken is None:
                print(f"{robot}: {events} events, {effects} effects, all equal")
            else:
                differing += 1
                print(f"{robot}: effects differ after {broken} events")
    except RecordingError as error:
        return fail(str(error))
    return 1 if differing else 0


def _report(options: argparse.Namespace) -> int:
    from deploy.runs import report

    path = report(options)
    print(json.dumps({"report": str(path)}) if not sys.stdout.isatty() else f"report: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
