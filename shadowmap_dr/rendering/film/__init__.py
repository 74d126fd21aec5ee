"""From samples to the images of films: windows, reconstruction filters, further channels."""
