"""Plants, the sampled closed loop, and metrics of its runs."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules={"metrics"})
