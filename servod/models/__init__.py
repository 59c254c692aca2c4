"""(set by its owner)"""
