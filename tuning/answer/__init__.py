"""The default answer of `tune`: many plants, noise, priced inputs and a safety filter."""
