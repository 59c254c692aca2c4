"""Reports for people: one HTML file that needs no network, plain sentences first, pictures after.

page.py         builds a page from verdict, signature, sentences, tables and figures; page.css is its look
figure.py       a figure as plain values: curves thinned for the eye, axes, panels, tables
page_figure.py  the same for a page, where page.js draws it; pictures.py as PNG and SVG
figures/        the figures of identification, design and motion
diagnosis.py    the page of a diagnosis
responses.py    responses of the linearised loop
"""
