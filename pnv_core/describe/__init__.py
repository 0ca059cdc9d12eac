"""An image to a PlaceDescriptor: trunk, NetVLAD, patches, and the files that hold them."""
