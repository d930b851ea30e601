"""Shape annotations are executed under pytest: every call into the package checks its array shapes."""

from jaxtyping import install_import_hook

install_import_hook("nbs_pin", "beartype.beartype")
