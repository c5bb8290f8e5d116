"""Device passes of the hash encoder and the decoder, without torch."""
