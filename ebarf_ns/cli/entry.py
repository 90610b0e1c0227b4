"""Dispatch of the ``ebarf`` command: help and subcommand names need no heavy imports."""

import signal
import sys
from difflib import get_close_matches
from importlib.metadata import version

COMMANDS = {
    "simulate": "make a scene of a simulated event camera, with the truth beside it",
    "process": "make a scene of a recording, whatever wrote it",
    "inspect": "say what is in a scene or a recording, what looks wrong, and how it will be trained",
    "train": "train on a scene: ns-train ebarf --data SCENE, which has all the flags",
    "evaluate": "show a finished run's errors, and write its report again",
    "render": "pictures or a video along a run's trajectory, or the events that it predicts",
    "mesh": "a run's surfaces as a mesh",
    "points": "a run's surfaces as a point cloud",
    "trajectory": "estimate one from events alone, compare two, export a refined one, give one errors",
    "bench": "measure speed, or compare methods",
    "replay": "repeat the step whose bad numbers ended a training, and say where they begin",
}
_LINES = "\n".join(f"  {name:<12}{does}" for name, does in COMMANDS.items())
_HELP = f"""\
usage: ebarf COMMAND ...

Train a NeRF on the events of a moving event camera and a rough trajectory of it, which is refined on the way.

A first use, of your own recording:
  ebarf process auto recording.raw --camera calibration.yaml --trajectory odometry.txt --output scene
  ebarf inspect scene
  ebarf train scene
Without one, "ebarf simulate scene" comes first instead.

commands (ebarf COMMAND --help says more):
{_LINES}

ns-viewer, ns-eval, ns-render and ns-export open a trained run with --load-config RUN/config.yml.
"""


def entrypoint() -> None:
    """The console script."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help", "help"):
        print(_HELP, end="")
    elif words[0] == "--version":
        print(version("ebarf_ns"))
    elif words[0] == "train":
        from ebarf_ns.cli.train_command import train

        train(words[1:])
    elif words[0] in COMMANDS:
        # Like Ctrl-C, it raises an exception, so that partly written files are removed.
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
        try:
            from ebarf_ns.cli.main import entrypoint as run

            run()
        except KeyboardInterrupt:
            raise SystemExit(128 + signal.SIGINT) from None
    else:
        near = get_close_matches(words[0], COMMANDS, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        print(f"error: {words[0]} is no command, expected one of {', '.join(COMMANDS)}{hint}", file=sys.stderr)
        raise SystemExit(2)
