from icrl4aht_generation.cli import main

main()
