"""What the tests of the study share with those of the application."""

from tests.integration.conftest import comparison, one_store, tables_alone

__all__ = ["comparison", "one_store", "tables_alone"]
