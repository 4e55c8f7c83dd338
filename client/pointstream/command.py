"""The command ``pointstream``: gathers the sub-commands of all installed packages and tells every failure in one line.

Packages name their sub-commands in the entry point group ``pointstream.commands`` (pyproject.toml). A package is
imported only when its sub-command is asked for, so ``pointstream --help`` is quick, and an installation without
the extras still has the commands that need none of them.

Exit status: 0 done; 1 the answer is no, or it failed, with one line on stderr; 2 the arguments are wrong;
130 interrupted.
"""

from __future__ import annotations

import os
import sys
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

import click
from click.exceptions import NoArgsIsHelpError

from lpc.errors import LpcError

from . import __version__

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

GROUP = "pointstream.commands"

SUMMARIES: Mapping[str, str] = {
    "demo": "The whole tour: build, serve, stream and draw a scan.",
    "build": "Turn scans into one .lpc model.",
    "info": "Say what a model holds.",
    "verify": "Check a model, and its samples against the scans.",
    "export": "Write a model's samples to a scan file.",
    "fetch": "Copy a model, or a part of it, for use offline.",
    "serve": "Serve the models of a directory over HTTP.",
    "sign": "Sign an address of a model or folder, for a time.",
    "doctor": "Say whether a host can serve models, and what to change.",
    "link": "Put a slow link in front of a server.",
    "stream": "Stream a model over a link and report what arrived when.",
    "estimate": "Say what a view of a model will cost, in bytes and seconds.",
    "render": "Draw a model into a picture, or a path into many.",
    "view": "Open a window on a model.",
}
"""Help by name, in the order of a first tour: what ``--help`` prints without importing anything."""

EXTRAS: Mapping[str, str] = {"build": "server", "serve": "server", "sign": "server", "view": "client,window"}
"""Extra of the distribution that a command needs; the others need ``client``."""

OWN_PACKAGES = frozenset({"lpc", "pointbuild", "pointserve", "pointstream", "pointlink", "pointview"})


def installed_commands() -> dict[str, EntryPoint]:
    """Entry points by command name, those of `SUMMARIES` first."""
    found = {point.name: point for point in entry_points(group=GROUP)}
    order = [name for name in SUMMARIES if name in found] + sorted(found.keys() - SUMMARIES.keys())
    return {name: found[name] for name in order}


class Failure(click.ClickException):
    """A failure that a person can do something about: one line, exit status 1."""

    exit_code = 1

    def __init__(self, error: object) -> None:
        super().__init__(" ".join(str(error).split()))

    def show(self, file: Any = None) -> None:
        """Print the line."""
        click.echo(f"pointstream: {self.message}", file=file, err=file is None)


class LazyGroup(click.Group):
    """A group whose commands are imported when they are asked for, and whose failures are `Failure`."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Names of the installed commands."""
        return list(installed_commands())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Import one command; None if there is none of that name."""
        point = installed_commands().get(cmd_name)
        if point is None:
            return None
        try:
            command = point.load()
        except ModuleNotFoundError as error:
            raise missing_module(cmd_name, error) from error
        if not isinstance(command, click.Command):
            raise Failure(f"{point.value} is no command; reinstall pointstream")
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands from `SUMMARIES`, importing none of them."""
        names = self.list_commands(ctx)
        if names:
            with formatter.section("Commands"):
                formatter.write_dl([(name, SUMMARIES.get(name, "")) for name in names])

    def invoke(self, ctx: click.Context) -> None:
        """Run the command and turn what may go wrong outside the program into `Failure`."""
        try:
            super().invoke(ctx)
        except LpcError as error:
            raise Failure(error) from error
        except ModuleNotFoundError as error:
            raise missing_module(ctx.invoked_subcommand or "this command", error) from error
        except BrokenPipeError:
            raise
        except OSError as error:
            place = f": {error.filename}" if error.filename is not None else ""
            raise Failure(f"{error.strerror or error}{place}") from error
        except MemoryError as error:
            raise Failure("not enough memory; ask for less at once, or lower --memory or --budget") from error


def missing_module(command: str, error: ModuleNotFoundError) -> Exception:
    """Failure that names the extra to install; the error itself if the module is not one that an extra brings."""
    name = (error.name or "").partition(".")[0]
    if not name or (name in OWN_PACKAGES and error.name != name):
        return error  # a module of ours is missing in a package that is there: a broken installation
    extra = EXTRAS.get(command, "client")
    return Failure(f"`{command}` needs {name}, which is not installed: pip install 'pointstream[{extra}]'")


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="pointstream")
def cli() -> None:
    """Publish huge point-sampled models on any web server, and browse them over slow links."""


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and give its exit status."""
    try:
        # Outside click's standalone mode the status of ctx.exit() is what main returns.
        status = cli.main(list(sys.argv[1:] if arguments is None else arguments), "pointstream", standalone_mode=False)
        sys.stdout.flush()
    except NoArgsIsHelpError as error:
        error.show()
        return error.exit_code
    except click.UsageError as error:
        place = "pointstream" if error.ctx is None else error.ctx.command_path
        message = " ".join(error.format_message().split()).removesuffix(".")
        click.echo(f"pointstream: {message}; see '{place} --help'", err=True)
        return error.exit_code
    except click.ClickException as error:
        (error if isinstance(error, Failure) else Failure(error.format_message())).show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        click.echo("pointstream: interrupted", err=True)
        return 130
    except BrokenPipeError:
        # Whoever read our output has gone (`pointstream info ... | head`); Python must not complain about it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return status if isinstance(status, int) else 0


def main() -> None:
    """Entry point of the script ``pointstream``."""
    sys.exit(run())
