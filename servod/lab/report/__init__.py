"""Reports for people: one HTML file that needs no network, plain sentences first, pictures after.

figure.py       a figure as plain values: curves, axes, panels, tables
page.py         builds a page from verdict, signature, sentences, tables and figures; page.css is its look
page.js         draws the figures in the page; pictures.py draws the same as PNG and SVG
figures/        the figures of identification, design and motion
diagnosis.py    the page of a diagnosis
responses.py    responses of the linearised loop
"""
