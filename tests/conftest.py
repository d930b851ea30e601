"""Shape annotations are executed under pytest: every call into the package checks its array shapes."""

import pytest
from jaxtyping import config, install_import_hook

install_import_hook("nbs_pin", "beartype.beartype")


@pytest.fixture
def without_type_checks():
    """What a user meets, whose arguments nothing looks at before the package does."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)
