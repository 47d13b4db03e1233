"""The default answer of `tune`: gains for many plants at once, with noise, priced inputs, a filter."""
