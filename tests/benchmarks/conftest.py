"""What the tests of the benches share."""

from tests.integration.conftest import one_store

__all__ = ["one_store"]
