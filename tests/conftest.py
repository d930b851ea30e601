"""Where the files of contracts run, every call into the package checks its array shapes, as they are annotated."""

import os
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads of torch wait for each other beside those of other workers

import pytest
from jaxtyping import config as shapes, install_import_hook
from threadpoolctl import threadpool_limits

threadpool_limits(1)  # numpy is imported already, by a plugin; two threads of its own take up to five times the time

CONTRACTS = {"test_dynamics", "test_controllers", "test_compiled", "test_plants", "test_networks", "test_lyapunov_laws"}
"""Test files that execute the annotations. Elsewhere the checks, and even checks that are switched off, would take more
time than the tests: a session that names none of these files has none, and test_contracts.py runs them in its own."""


def pytest_configure(config):
    """Lets a session execute annotations if it names a file of contracts."""
    config.executes_annotations = bool(CONTRACTS & {Path(name.split("::")[0]).stem for name in config.args})
    if config.executes_annotations:
        install_import_hook("nbs_pin", "beartype.beartype")


def pytest_ignore_collect(collection_path, config):
    """Leaves the files of contracts to the session that test_contracts.py starts, unless they were named."""
    return True if collection_path.stem in CONTRACTS and not config.executes_annotations else None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Checks shapes in the contract files alone, in their fixtures too."""
    shapes.update("jaxtyping_disable", item.path.stem not in CONTRACTS)
    return (yield)


@pytest.fixture
def without_type_checks():
    """What a user meets, whose arguments nothing looks at before the package does."""
    before = shapes.jaxtyping_disable
    shapes.update("jaxtyping_disable", True)
    yield
    shapes.update("jaxtyping_disable", before)
