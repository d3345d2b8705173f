"""The strict glTF 2.0 reader."""
