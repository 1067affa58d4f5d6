"""What the tests of the study share with those of the application."""

from tests.integration.conftest import comparison, denormal_numbers, one_store, tables_alone

__all__ = ["comparison", "denormal_numbers", "one_store", "tables_alone"]
