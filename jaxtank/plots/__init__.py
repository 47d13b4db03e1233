"""Pictures on given matplotlib axes; the only folder of this package that imports matplotlib."""
