"""In the contract tests every call into the package checks its array shapes, as they are annotated."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads of torch wait for each other beside those of other workers

import pytest
from jaxtyping import config, install_import_hook

CONTRACTS = {"test_dynamics", "test_controllers", "test_compiled", "test_plants", "test_networks", "test_lyapunov_laws"}
"""Test files that execute the annotations; elsewhere the checks would take more time than the tests."""

install_import_hook("nbs_pin", "beartype.beartype")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Checks shapes in the contract files alone, in their fixtures too."""
    config.update("jaxtyping_disable", item.path.stem not in CONTRACTS)
    return (yield)


@pytest.fixture
def without_type_checks():
    """What a user meets, whose arguments nothing looks at before the package does."""
    before = config.jaxtyping_disable
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", before)
