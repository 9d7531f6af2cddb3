within Drives.Interfaces;
connector RealOutput = output Real "Signal out of a component";
