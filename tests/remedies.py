"""Options that messages name, and the commands that have them."""

import functools
import re

import click
from ertis_cli.main import COMMANDS, cli

OPTION = re.compile(r"(?<![\w-])--[a-z](?:[a-z0-9-]*[a-z0-9])?")
OF_ALL = frozenset({"--help", "--config", "--version"})
_NAMED = re.compile(r"ertis ([a-z-]+)")


@functools.cache
def options_of(name):
    """Options of a command and its subcommands."""
    return frozenset(_options(cli.get_command(click.Context(cli, **cli.context_settings), name))) | OF_ALL


def _options(command):
    found = {option for each in command.params for option in (*each.opts, *each.secondary_opts)}
    return found.union(*(_options(each) for each in getattr(command, "commands", {}).values()))


def every_option():
    return frozenset().union(*map(options_of, COMMANDS))


def strange_options(message, command):
    """Options that a message names although neither the command nor one named in the message has them."""
    known = [options_of(name) for name in (command, *_NAMED.findall(message)) if name in COMMANDS]
    return {*OPTION.findall(message)}.difference(OF_ALL, *known)
