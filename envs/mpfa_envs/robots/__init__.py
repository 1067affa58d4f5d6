"""Two-wheeled robots: their measures, their motion and its errors."""
