"""Reports for people: one HTML file that needs no network, plain sentences first, pictures after.

page.py         builds a page from sentences, tables and figures
figure.py       a figure as plain values: curves thinned for the eye, axes, panels, tables
page_figure.py  the same as plotly, pictures.py as PNG and SVG
figures/        the figures of identification, design and motion
diagnosis.py    the page of a diagnosis
responses.py    responses of the linearised loop
"""
