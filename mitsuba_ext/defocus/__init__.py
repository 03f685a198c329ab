"""Depth of field as a filter of pictures: colour, depth and a lens in, a picture out
(:func:`filters.defocus`); or layers of what hides what (:class:`filters.Capture`)."""
