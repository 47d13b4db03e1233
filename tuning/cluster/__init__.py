"""Tasks on a Dask cluster: the engine, workers of this machine, and a case as a worker gets it."""
