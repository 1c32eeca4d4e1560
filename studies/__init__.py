"""What the paper measured and what it leaves open, each as one small file to run again."""
