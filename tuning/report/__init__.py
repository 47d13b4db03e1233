"""Results as text, tables, JSON, pictures and pages."""
