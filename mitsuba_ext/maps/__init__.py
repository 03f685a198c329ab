"""What is learned and stored: tables of lights, visibilities and densities, with lookups that
decisions trace into kernels. Nothing here knows who fills them or who reads them."""
