"""What a diagnosis reads: recordings taken in, judged for what they can tell, as traces."""
