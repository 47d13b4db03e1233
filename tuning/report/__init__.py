"""Reports: a module for each kind of result has `report`, `json_of` (the object of --json),
`verdict_of`, `advice_of`, `figures` {name: Figure}, CAPTIONS, `files_of` {name: content}, `save`.
"""
