"""Reports for people: one HTML file that needs no network, plain sentences first, pictures after.

page.py    builds a page from sentences, tables and plotly figures
curves.py  time curves thinned for the eye, and histograms
demo.py    the page of `servoctl demo`
"""
