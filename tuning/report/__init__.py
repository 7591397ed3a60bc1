"""The report of a command: one HTML page that needs no network, see `tuning.report.page`.

`explorer` turns walks and grids into what the page's script draws; one file per command says what stands on its page.
"""
