"""Tests of statistics, tables and figures of many runs."""
