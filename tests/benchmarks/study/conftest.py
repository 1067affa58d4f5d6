"""What the tests of the study share with those of the application."""

from tests.integration.conftest import one_store, study, tables_alone

__all__ = ["one_store", "study", "tables_alone"]
