within Drives.Interfaces;
connector RealInput = input Real "Signal into a component";
