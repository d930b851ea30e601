"""The registered laws as the contract tests take them: a new law is in each of them without another word."""

from functools import partial

from nbs_pin.controllers.registry import LAWS, build_law
from nbs_pin.robots.robot import load_robot

EVERY = {name: partial(build_law, name) for name in LAWS}
"""Makers of all laws: robot and settings to controller."""
COMPILED = {name: make for name, make in EVERY.items() if make(load_robot("two_link")).packable}
"""Those that have a kernel."""
