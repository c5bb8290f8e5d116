"""The device passes of the hash encoder and of the decoder, without torch."""
