"""meshcat's server, on this machine only: on its own it would listen at every address of the machine."""

import functools

import meshcat.servers.zmqserver
import tornado.web

LOOPBACK = "127.0.0.1"


def main() -> None:
    """Serve until killed; prints where, as meshcat's own server does."""
    listen = functools.partialmethod(tornado.web.Application.listen, address=LOOPBACK)
    setattr(tornado.web.Application, "listen", listen)  # noqa: B010  # a type checker takes it for a mistake
    meshcat.servers.zmqserver.main()


if __name__ == "__main__":
    main()
