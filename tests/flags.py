"""Command lines read as LeRobot's commands do."""

from functools import cache

from draccus.argparsing import ArgumentParser


@cache
def parser_of(config_class):
    """Draccus reads the sources of all configs for its help, a second for `CronosTrainConfig`: once is enough.

    It knows the choices (policies, agents, task orders) that are registered by then.
    """
    return ArgumentParser(config_class=config_class)


def parse_flags(config_class, arguments):
    return parser_of(config_class).parse_args(list(arguments))
